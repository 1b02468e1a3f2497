"""Cameras of a log: colours and depths in pairs, calibrated, without distortion."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.recording.logs.cfg import ImportCfg
from concent_warp.recording.logs.log_map import ImageEntry, LogMap
from concent_warp.recording.logs.numbers import clean_times, delay_of
from concent_warp.recording.logs.readers.calibration import Calibration
from concent_warp.recording.logs.readers.image_folder import CAMERA
from concent_warp.recording.logs.readers.log import Episode, Images
from concent_warp.recording.logs.readers.transforms import pose_between
from concent_warp.recording.logs.units import DEPTHS
from concent_warp.recording.recording import ImageStream

ALIGN = (
    "export depth registered to colour: rs.align in RealSense's SDK, /camera/aligned_depth_to_color in ROS, depth "
    "registration in Orbbec's SDK"
)


@dataclass(frozen=True)
class Camera:
    """One camera of an episode, before its frames are decoded and its time 0 is known."""

    name: str
    where: str
    """Its place in the map."""
    color: Images
    depth: Images | None
    time: np.ndarray
    """[s], shape (T,), on the log's clock."""
    color_rows: np.ndarray
    """Rows of the colours, shape (T,) int."""
    depth_rows: np.ndarray
    """Rows of the depths, shape (T,) int; empty without depth."""
    calibration: Calibration
    pose: np.ndarray
    """Camera-to-world, or camera-to-body with `body`, shape (4, 4)."""
    body: str | None
    depth_unit: str
    """Unit of the depths, empty for that of their type."""
    depth_from: float
    """Distance below which a depth counts as missing [m]."""
    delay: float | None = None
    """Median of reception less time [s]; None where the log has one clock."""

    @property
    def bytes(self) -> int:
        """Size of all frames in memory."""
        height, width = self.color.size
        return len(self.time) * height * width * 7

    def unit(self) -> str:
        """Return the unit of the depths, from their type where neither map nor log states it."""
        if self.depth_unit or self.depth is None:
            return self.depth_unit or "m"
        return "mm" if next(iter(self.depth.frames(self.depth_rows[:1]))).dtype.kind in "ui" else "m"

    def stream(
        self, start: float, rows: np.ndarray | None = None, tick: Callable[[int], None] | None = None
    ) -> ImageStream:
        """Decode frames.

        Args:
            start: Time 0 on the log's clock [s].
            rows: Which frames, ascending, shape (n,) int; all by default.
            tick: Called with the number of frames done.

        Raises:
            RecordingError: A frame cannot be decoded or has another size.
        """
        rows = np.arange(len(self.time)) if rows is None else rows
        height, width = self.color.size
        rgb = np.empty((len(rows), height, width, 3), np.uint8)
        depth = np.zeros((len(rows), height, width), np.float32)
        flat = self.calibration.undistorter(self.color.size, depth=False)
        for k, frame in enumerate(self.color.frames(self.color_rows[rows])):
            rgb[k] = flat(self._sized(frame, k, self.color.name))
            if tick is not None and self.depth is None:
                tick(k + 1)
        if self.depth is not None:
            flat = self.calibration.undistorter(self.color.size, depth=True)
            for k, frame in enumerate(self.depth.frames(self.depth_rows[rows])):
                depth[k] = flat(self._metres(self._sized(frame, k, self.depth.name)))
                if tick is not None:
                    tick(k + 1)
        time = self.time[rows] - start
        return ImageStream(time, rgb, depth, self.calibration.intrinsics, self.pose, self.body)

    def _sized(self, frame: np.ndarray, k: int, name: str) -> np.ndarray:
        """Return a frame of the size that all have."""
        if frame.shape[:2] != self.color.size:
            raise RecordingError(
                "the frames differ in their size", where=f"{name}, frame {k}", expected=self.color.size,
                found=frame.shape[:2],
            )  # fmt: skip
        return frame

    def _metres(self, frame: np.ndarray) -> np.ndarray:
        """Return depths in metres, float32, 0 where there is none."""
        unit = self.depth_unit or ("mm" if frame.dtype.kind in "ui" else "m")
        metres = frame.astype(np.float32) * np.float32(DEPTHS[unit])
        return np.where(np.isfinite(metres) & (metres >= self.depth_from), metres, np.float32(0))


def find_camera(
    name: str, entry: ImageEntry, episode: Episode, mapping: LogMap, file: Mapping[str, Calibration],
    m: mujoco.MjModel, cfg: ImportCfg,
) -> Camera:  # fmt: skip
    """Return a camera that the map names.

    Args:
        name: Its name in the recording.
        entry: What the map says.
        episode: The episode.
        mapping: The map.
        file: Cameras of ``calibration.json``.
        m: The compiled scene.
        cfg: Settings.

    Raises:
        RecordingError: There are no such images, they are not registered or do not pair, or calibration is missing.
    """
    where = mapping.where("image", name)
    color = _images(entry.color, episode, where, depth=False)
    depth = _images(entry.depth, episode, where, depth=True) if entry.depth else None
    if depth is not None and depth.size != color.size:
        raise RecordingError(
            "the depths are not registered to the colours", where=where,
            expected=f"the size of {color.name}, {color.size[0]} x {color.size[1]}",
            found=f"{depth.size[0]} x {depth.size[1]}", fix=ALIGN,
        )  # fmt: skip
    calibration = _calibration(name, entry, episode, file, where)
    if calibration.problem:
        raise RecordingError(calibration.problem.rstrip("."), where=where)
    if calibration.size is not None and calibration.size != color.size:
        raise RecordingError(
            "the intrinsics are of images of another size", where=where, expected=f"{color.size[0]} x {color.size[1]}",
            found=f"{calibration.size[0]} x {calibration.size[1]}", fix="give those of the recorded resolution",
        )  # fmt: skip
    if not calibration.intrinsics.any():
        raise RecordingError("the intrinsics are missing: all are 0", where=where, fix="calibrate the camera")
    if not min(calibration.intrinsics[0, 0], calibration.intrinsics[1, 1]) > 0:
        found = calibration.intrinsics.diagonal()[:2].tolist()
        raise RecordingError("a focal length is not right", where=where, expected="fx and fy above 0 px", found=found)
    body = entry.body or calibration.body
    if body is not None and mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, body) < 0:
        known = [m.body(i).name for i in range(1, m.nbody)]
        raise RecordingError("the scene has no such body", where=where, expected=f"one of {known}", found=repr(body))
    pose = _pose(entry, calibration, color, episode, where)
    time, color_rows, _ = clean_times(color, mapping.clock_of(color.name), cfg.plausibility)
    depth_rows = np.zeros(0, int)
    if depth is not None:
        depth_time, rows, _ = clean_times(depth, mapping.clock_of(depth.name), cfg.plausibility)
        kept, nearest = _pairs(time, depth_time, cfg.max_pair_delay, where, color, depth)
        time, color_rows, depth_rows = time[kept], color_rows[kept], rows[nearest]
    unit = entry.depth_unit or ("" if depth is None else depth.unit)
    delay = delay_of(color, mapping.clock_of(color.name))
    return Camera(
        name, where, color, depth, time, color_rows, depth_rows, calibration, pose, body, unit, cfg.depth_from, delay
    )


def _images(source: str, episode: Episode, where: str, *, depth: bool) -> Images:
    """Return a stream of images by its name."""
    kind = "depths" if depth else "colours"
    known = sorted(name for name, one in episode.images.items() if one.depth == depth)
    if not source:
        raise RecordingError(f"the entry names no {kind}", where=where, expected=f"color = one of {known}")
    if source in episode.unread:
        raise RecordingError(episode.unread[source].rstrip("."), where=f"{where}, {source}")
    found = episode.images.get(source)
    if found is None or found.depth != depth:
        raise RecordingError(
            f"the log has no such {kind}", where=where, expected=f"one of {known}" if known else "a log with images",
            found=repr(source) + ("" if found is None else ", whose frames are of the other kind"),
        )  # fmt: skip
    if not len(found.time):
        raise RecordingError("the stream has no frames", where=where, found=source)
    return found


def _calibration(
    name: str, entry: ImageEntry, episode: Episode, file: Mapping[str, Calibration], where: str
) -> Calibration:
    """Return the calibration of a camera: that of the file, with the log's own where it is named or fits."""
    known = {**episode.calibration, **file}
    if entry.calibration:
        if entry.calibration not in known:
            raise RecordingError(
                "no such calibration", where=where, expected=f"one of {sorted(known)}", found=repr(entry.calibration)
            )
        return known[entry.calibration]
    last = entry.color.replace("/", ".").split(".")[-1]
    beside = f"{entry.color.rpartition('/')[0]}/camera_info"
    above = f"{entry.color.rpartition('/')[0].rpartition('/')[0]}/camera_info"  # .../image_raw/compressed
    for one in (name, entry.color, last, beside, above, CAMERA):
        if one in known:
            return known[one]
    raise RecordingError(
        "the intrinsics of the camera are missing", where=where,
        expected=f"camera {name!r} in calibration.json, or a CameraInfo",
        found=f"those of {sorted(known)}" if known else "none",
        fix=f"write calibration.json beside the log (see docs/import.md), or leave [image.{name}] out of the map",
    )  # fmt: skip


def _pose(entry: ImageEntry, calibration: Calibration, color: Images, episode: Episode, where: str) -> np.ndarray:
    """Return the pose of a camera, shape (4, 4)."""
    if entry.pose is not None:
        return entry.pose
    if entry.reference:
        return pose_between(episode.transforms, entry.frame or color.frame, entry.reference, where)
    if calibration.pose is not None:
        return calibration.pose
    frames = sorted(episode.transforms.parents)
    fix = 'write pose = [[...], ...] (camera-to-world, z forward) here or "pose" in calibration.json'
    if frames:
        fix += f", or reference = the frame of the scene's world, from the transforms of the log ({frames[:8]})"
    raise RecordingError("the pose of the camera is not known", where=where, fix=fix)


def _pairs(
    color: np.ndarray, depth: np.ndarray, longest: float, where: str, of_color: Images, of_depth: Images
) -> tuple[np.ndarray, np.ndarray]:
    """Return the colours that have a depth, and the nearest depth of each, as rows (n,) int."""
    right = np.clip(np.searchsorted(depth, color), 1, max(len(depth) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(depth) - 1)
    nearest = np.where(np.abs(depth[right] - color) < np.abs(depth[left] - color), right, left)
    apart = np.abs(depth[nearest] - color)
    kept = np.flatnonzero(apart <= longest)
    if 2 * len(kept) < len(color):
        raise RecordingError(
            "colours and depths are not of the same times", where=where,
            expected=f"a depth within {longest:g} s of each colour", found=f"{np.median(apart):.3g} s in the median",
            fix=f"set the clock of {of_color.name!r} or {of_depth.name!r} in [clock]",
        )  # fmt: skip
    return kept, nearest[kept]
