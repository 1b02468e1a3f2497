"""The live view of tracking in the browser: the newest frames with outlines, and the states of all bodies so far."""

from __future__ import annotations

import contextlib
import io
import time
from typing import Any

import numpy as np

from concent_warp.perception.tracking.geometry.outline import Outline
from concent_warp.perception.tracking.moment import TrackedMoment
from concent_warp.report.live_server import started_server
from concent_warp.report.tracking.cfg import LiveTrackCfg

OUTLINE_COLOUR, COVERED_COLOUR, LOST_COLOUR = (55, 255, 139), (140, 190, 160), (215, 30, 70)
"""Colours, red, green, blue, of what is seen and covered of tracked bodies, and of lost ones."""
HEIGHT = 720
"""Least height of the picture; smaller frames are enlarged [px]."""
STRIP = (360, 14)
"""Width and height of the strip of states of a body [px]."""
BORDER = 235
"""Brightness around the picture."""
LINE_BITS = 4
"""Bits of the fraction of a pixel in the coordinates of lines."""


class LiveTrackView:
    """A server that shows a video while it is tracked."""

    def __init__(self, cfg: LiveTrackCfg) -> None:
        """Start the server.

        Raises:
            ConcentError: The address cannot be served on.
        """
        self._cfg = cfg
        self._server = started_server(cfg.host, cfg.port)
        # Beside the picture, not above it.
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_layout="fixed")
        self._message = self._server.gui.add_markdown("Waiting for the first frame.")
        self._images: dict[str, Any] = {}
        self._states: dict[str, list[bool]] = {}
        self._demonstration = ""
        self._shown = -np.inf

    @property
    def address(self) -> str:
        """URL of the page."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def stop(self) -> None:
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def show(self, moment: TrackedMoment) -> None:
        """Take note of a moment, and show it unless the last picture is too recent."""
        if moment.demonstration != self._demonstration:
            self._demonstration, self._states = moment.demonstration, {}
        for body in moment.bodies:
            self._states.setdefault(body.shape.name, []).append(body.pose is not None)
        last = moment.number == moment.count - 1
        if not last and time.monotonic() - self._shown < self._cfg.period:
            return
        self._shown = time.monotonic()
        with self._server.atomic():
            self._message.content = message(moment, self._states)
            pictures = [
                picture(view.rgb, list(moment.outlines(view).values()), lost=moment.lost) for _, view in moment.views
            ]
            whole = side_by_side(pictures)
            for client in self._server.get_clients().values():
                client.scene.set_background_image(padded(whole, client.camera.aspect), format="jpeg")
            for body, states in self._states.items():
                self._put(f"{body}: tracked (green), lost (red)", strip(states, moment.count))

    def _put(self, label: str, image: np.ndarray) -> None:
        """Show an image (H, W, 3) under a label."""
        if label in self._images:
            self._images[label].image = image
        else:
            self._images[label] = self._server.gui.add_image(image, label=label, format="jpeg")


def message(moment: TrackedMoment, states: dict[str, list[bool]]) -> str:
    """Return the state of a moment in Markdown.

    Args:
        moment: The moment.
        states: Whether each body was tracked in each moment so far.
    """
    cameras = ", ".join(_plain(camera) for camera, _ in moment.views)
    lines = [
        f"**{_plain(moment.demonstration)}**, {moment.time:.2f} s, frame {moment.number + 1} of {moment.count}",
        f"from left to right: {cameras}",
    ]
    lines = lines if len(moment.views) > 1 else lines[:1]
    for body in moment.bodies:
        seen = states[body.shape.name]
        now = "tracked" if body.pose is not None else f"**lost**: {_plain(body.reason)}"
        lines.append(f"{_plain(body.shape.name)}: {now}; tracked in {sum(seen)} of {len(seen)} frames so far")
    return "\n\n".join(lines)


def picture(rgb: np.ndarray, outlines: list[Outline], *, lost: bool) -> np.ndarray:
    """Return a frame (H, W, 3) with outlines, framed where a body is lost."""
    import cv2

    factor = max(1, -(-HEIGHT // rgb.shape[0]))
    image = cv2.resize(np.ascontiguousarray(rgb), None, fx=factor, fy=factor, interpolation=cv2.INTER_LINEAR)
    for lines in outlines:
        for segment, covered in zip(lines.segments, lines.covered, strict=True):
            # Centres of pixels have whole coordinates, before and after.
            first, second = np.round((factor * (segment + 0.5) - 0.5) * 2**LINE_BITS).astype(int).tolist()
            colour = COVERED_COLOUR if covered else OUTLINE_COLOUR
            cv2.line(image, first, second, colour, 1 if covered else 2, cv2.LINE_AA, LINE_BITS)
    if lost:
        cv2.rectangle(image, (0, 0), (image.shape[1] - 1, image.shape[0] - 1), LOST_COLOUR, 8)
    return image


def side_by_side(pictures: list[np.ndarray]) -> np.ndarray:
    """Return pictures (H, W, 3) of several sizes beside one another, as high as the highest."""
    import cv2

    height = max(p.shape[0] for p in pictures)
    sizes = [(round(p.shape[1] * height / p.shape[0]), height) for p in pictures]
    return np.concatenate([cv2.resize(p, size) for p, size in zip(pictures, sizes, strict=True)], axis=1)


def padded(image: np.ndarray, aspect: float) -> np.ndarray:
    """Return an image (H, W, 3) with grey borders that give it an aspect, width over height: viser fills the window."""
    height, width = image.shape[:2]
    size = (max(height, round(width / aspect)), max(width, round(height * aspect)))
    result = np.full((*size, 3), BORDER, dtype=np.uint8)
    top, left = (size[0] - height) // 2, (size[1] - width) // 2
    result[top : top + height, left : left + width] = image
    return result


def strip(states: list[bool], count: int) -> np.ndarray:
    """Return states so far over all moments as an image (height, width, 3)."""
    width, height = STRIP
    colours = np.full((count, 3), 225, dtype=np.uint8)
    colours[: len(states)] = np.where(np.array(states)[:, None], (26, 127, 75), LOST_COLOUR)
    columns = np.linspace(0, count - 1, width).round().astype(int)
    return np.repeat(colours[columns][None], height, axis=0)


def _plain(text: str) -> str:
    """Return a text that Markdown leaves as it is."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]()<>#+-.!|~" else c for c in text)
