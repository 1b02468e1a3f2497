"""Detection of AprilTag, ArUco, ChArUco and grid targets by `cv2.aruco`.

Pixels have (0, 0) at the centre of the first one. A tag's frame is at its middle, x to the right and y upwards in the
upright print, z towards the viewer; a board's frame is OpenCV's, at its upper left corner with y downwards.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.perception.calibration.cfg import CalibrateCfg, CalibrationTargetCfg
from concent_warp.perception.calibration.tag_edges import refine_corners
from concent_warp.recording.recording import ImageStream

CORNERS = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])
"""Corners of a tag of size 1 in the order of `cv2.aruco`, from the upper left clockwise."""
FEWEST_CORNERS = 6
"""Corners of a ChArUco board that are used from a frame at least."""
FAMILIES = (
    *("DICT_APRILTAG_36h11", "DICT_APRILTAG_25h9", "DICT_APRILTAG_16h5", "DICT_APRILTAG_36h10", "DICT_ARUCO_ORIGINAL"),
    *("DICT_ARUCO_MIP_36h12", "DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000"),
)
"""Dictionaries that are tried where the given one finds nothing, the common ones first."""
TRIED_FRAMES = 12
"""Frames in which other dictionaries are tried."""
SMALL_IMAGE = 160
"""Width below which images are said to be small [px]."""


@dataclass(frozen=True)
class TargetView:
    """A target in one frame."""

    frame: int
    """Row of the frame."""
    target: str
    """Name of the target."""
    points: np.ndarray
    """Corners in the frame of the target [m], shape (n, 3)."""
    pixels: np.ndarray
    """Where they are in the image [px], shape (n, 2)."""

    @property
    def edge(self) -> float:
        """Mean distance of neighbouring corners in the image [px]."""
        step = np.diff(self.pixels, axis=0, append=self.pixels[:1])
        return float(np.median(np.linalg.norm(step, axis=1)))


def dictionary_name(name: str) -> str:
    """Return the name in `cv2.aruco` of a dictionary, whose prefix may be missing.

    Raises:
        RecordingError: There is no such dictionary.
    """
    import cv2

    known = {entry.upper(): entry for entry in dir(cv2.aruco) if entry.startswith("DICT_")}
    for candidate in (name.upper(), f"DICT_{name.upper()}", f"DICT_APRILTAG_{name.upper().removeprefix('TAG')}"):
        if candidate in known:
            return known[candidate]
    shown = sorted({entry.removeprefix("DICT_") for entry in known.values()})
    raise RecordingError("there is no such tag dictionary", expected=f"one of {', '.join(shown)}", found=name)


def detect(
    stream: ImageStream, cfg: CalibrationTargetCfg, progress: Callable[[float], None] | None = None
) -> list[TargetView]:
    """Return all views of targets in the frames of a camera; tags smaller than any limit included.

    Args:
        stream: The frames.
        cfg: What to look for; `kind` auto means tags.
        progress: Called with the share done, 0..1.

    Raises:
        RecordingError: There is no such dictionary, or a board has no size.
    """
    find = _finder(cfg)
    views: list[TargetView] = []
    for t, frame in enumerate(stream.rgb):
        views += [TargetView(t, *found) for found in find(_grey(frame))]
        if progress is not None:
            progress((t + 1) / len(stream.rgb))
    return views


def no_target_error(stream: ImageStream, cfg: CalibrateCfg, where: str) -> RecordingError:
    """Return the error that says that no target is found, and why it may be so."""
    mistake = mistaken_target(stream, cfg, where)
    if mistake is not None:
        return mistake
    height, width = stream.rgb.shape[1:3]
    if width < SMALL_IMAGE:
        return RecordingError(
            _not_found(cfg), where=where, expected=f"tags with edges of {cfg.limits.min_edge:g} px",
            found=f"images of {width} x {height} px", fix="record larger images",
        )  # fmt: skip
    fix = "check the dictionary, focus and light, or align the robot itself by --method robot"
    return RecordingError(_not_found(cfg), where=where, fix=fix)


def mistaken_target(stream: ImageStream, cfg: CalibrateCfg, where: str) -> RecordingError | None:
    """Return the error that says what was mistaken where no target is found, None where no mistake is seen.

    It may be another dictionary or other ids, mirrored images, or images without light.
    """
    name, what = dictionary_name(cfg.target.dictionary), _not_found(cfg)
    rows = np.unique(np.linspace(0, len(stream.rgb) - 1, TRIED_FRAMES).astype(int))
    frames = [_grey(stream.rgb[row]) for row in rows]
    if max(float(frame.std()) for frame in frames) < 2:
        return RecordingError(what, where=where, found="images of a single brightness", fix="check exposure and stream")
    if (present := _best_dictionary(frames, [name])) is not None:
        other = f"tag {present[1]} in {present[2]:.0%} of the frames tried"
        if cfg.target.ids:
            expected = f"one of the ids {', '.join(map(str, cfg.target.ids))}"
            return RecordingError(what, where=where, expected=expected, found=other, fix="give other --ids")
        fix = "check kind, columns, rows and sizes of the board"
        return RecordingError(what, where=where, found=f"single tags, such as {other}", fix=fix)
    other = _best_dictionary(frames, [one for one in FAMILIES if one != name])
    if other is not None:
        found, number, share = other
        return RecordingError(
            what, where=where, found=f"tag {number} of {found} in {share:.0%} of the frames tried",
            fix=f"give --dictionary {found.removeprefix('DICT_')}",
        )  # fmt: skip
    if _best_dictionary([np.ascontiguousarray(frame[:, ::-1]) for frame in frames], [name]) is not None:
        return RecordingError(
            what, where=where, found="tags in the mirrored images", fix="record the images without mirroring them"
        )
    return None


def _not_found(cfg: CalibrateCfg) -> str:
    """Return what was not found."""
    kind = "board" if cfg.target.method in ("charuco", "grid") else "tag"
    return f"no {kind} of dictionary {dictionary_name(cfg.target.dictionary)} is seen in any frame"


def _best_dictionary(frames: list[np.ndarray], names: list[str]) -> tuple[str, int, float] | None:
    """Return dictionary, most frequent tag and the share of frames that it is in; None below a fourth of the frames."""
    best: tuple[str, int, float] | None = None
    for name in names:
        detector = _detector(name)
        seen: Counter[int] = Counter()
        for frame in frames:
            _, ids, _ = detector.detectMarkers(frame)
            seen.update(set() if ids is None else {int(i) for i in np.ravel(ids)})
        if seen:
            number, count = seen.most_common(1)[0]
            share = count / len(frames)
            if count >= 2 and share >= 0.25 and (best is None or share > best[2] + 0.2):
                best = name, number, share
    return best


def _detector(name: str) -> Any:
    """Return a detector of single tags that refines their corners."""
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(_dictionary(name), parameters)


def _dictionary(name: str) -> Any:
    """Return a dictionary of `cv2.aruco`."""
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary_name(name)))


def _finder(cfg: CalibrationTargetCfg) -> Callable[[np.ndarray], list[tuple[str, np.ndarray, np.ndarray]]]:
    """Return a function from an image to the names, corners [m] and pixels of the targets in it."""
    import cv2

    if cfg.method == "charuco":
        _check_board(cfg)
        board = cv2.aruco.CharucoBoard(cfg.board, cfg.spacing, cfg.tag_size, _dictionary(cfg.dictionary))
        detector, points = cv2.aruco.CharucoDetector(board), np.asarray(board.getChessboardCorners(), float)

        def board_corners(image: np.ndarray) -> list[tuple[str, np.ndarray, np.ndarray]]:
            corners, ids, _, _ = detector.detectBoard(image)
            if ids is None or len(ids) < FEWEST_CORNERS:
                return []
            return [("board", points[np.ravel(ids).astype(int)], np.reshape(corners, (-1, 2)).astype(float))]

        return board_corners
    tags = _detector(cfg.dictionary)
    cells = _dictionary(cfg.dictionary).markerSize + 2
    layout: dict[int, np.ndarray] = {}
    if cfg.method == "grid":
        _check_board(cfg)
        grid = cv2.aruco.GridBoard(cfg.board, cfg.tag_size, cfg.spacing, _dictionary(cfg.dictionary))
        ids = np.ravel(grid.getIds())
        layout = {int(i): np.asarray(c, float) for i, c in zip(ids, grid.getObjPoints(), strict=True)}

    def tag_corners(image: np.ndarray) -> list[tuple[str, np.ndarray, np.ndarray]]:
        corners, ids, _ = tags.detectMarkers(image)
        pairs = [] if ids is None else list(zip(np.ravel(ids).tolist(), corners, strict=True))
        counts = Counter(number for number, _ in pairs)
        found: dict[int, np.ndarray] = {}
        for number, corners_of_tag in pairs:  # a tag that is there twice is no landmark
            if counts[number] == 1 and (not cfg.ids or number in cfg.ids):
                refined = refine_corners(image, np.reshape(corners_of_tag, (4, 2)).astype(float), cells)
                if refined is not None:
                    found[number] = refined
        if not layout:
            return [(f"tag {n}", cfg.tag_size * CORNERS, c) for n, c in found.items()]
        known = [n for n in found if n in layout]
        if len(known) < 2:
            return []
        return [("board", np.concatenate([layout[n] for n in known]), np.concatenate([found[n] for n in known]))]

    return tag_corners


def _check_board(cfg: CalibrationTargetCfg) -> None:
    """Raise an error unless a board has columns, rows and a spacing."""
    if min(cfg.board) < 2 or cfg.spacing <= 0:
        raise RecordingError(
            f"the size of the {cfg.method} board is not stated",
            expected="columns and rows, and the edge of a square (charuco) or the gap between tags (grid) in metres",
            found=f"{cfg.board} and {cfg.spacing}",
            fix="give --board COLUMNS ROWS --spacing METRES",
        )
    if cfg.method == "charuco" and cfg.tag_size >= cfg.spacing:
        raise RecordingError(
            "a tag of a ChArUco board is smaller than its square",
            expected=f"a tag size below {cfg.spacing:g} m",
            found=f"{cfg.tag_size:g} m",
            fix="give --tag-size and --spacing in metres",
        )


def _grey(frame: np.ndarray) -> np.ndarray:
    """Return the brightness of a frame (H, W, 3), uint8, shape (H, W)."""
    import cv2

    return cv2.cvtColor(np.ascontiguousarray(frame), cv2.COLOR_RGB2GRAY)
