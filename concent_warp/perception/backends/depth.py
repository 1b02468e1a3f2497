"""Masks from depth, without learnt weights: what stands out from robot and static scene, followed from frame to frame.

Pixels in front of all that is known are divided where depth jumps. An object is the parts that its prompt lies on, and
then those that its mask of the frame before, widened, lies on at about the same depth. What touches an object at the
same depth cannot be separated from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from concent_warp.checks import check_settings
from concent_warp.perception.backends.cfg import DepthMaskerCfg
from concent_warp.perception.backends.protocols import CameraFrames, MaskPrompt

SAME_PART = 0.5
"""Least share of the pixels of a part that lie on the widened former mask, or in a prompt's box [-]."""


@dataclass(frozen=True)
class _Last:
    """Where an object was seen last."""

    mask: np.ndarray
    """Its pixels, shape (H, W) bool."""
    frame: int
    """The frame."""
    near: float
    """Depth of its nearest pixels [m], the nearest 5 % aside."""
    far: float
    """Depth of its farthest pixels [m], the farthest 5 % aside."""
    largest: int
    """Largest number of pixels that it had."""


class DepthMasker:
    """Masker by depth alone.

    Example:
        >>> import concent_warp as cw
        >>> import numpy as np
        >>> depth = np.full((3, 48, 64), 1.0, np.float32)
        >>> for frame in range(3):
        ...     depth[frame, 10:20, 20 + frame : 30 + frame] = 0.9
        >>> frames = cw.CameraFrames(np.zeros((3, 48, 64, 3), np.uint8), depth, lambda frame: np.ones((48, 64)))
        >>> masks = cw.DepthMasker().masks(frames, {"block": cw.MaskPrompt(0, np.array([[25.0, 15.0]]))})
        >>> masks["block"].sum(axis=(1, 2)).tolist()
        [100, 100, 100]
    """

    def __init__(self, cfg: DepthMaskerCfg | None = None) -> None:
        """Take settings."""
        self.cfg = cfg or DepthMaskerCfg()
        check_settings(self.cfg)

    def masks(self, frames: CameraFrames, prompts: Mapping[str, MaskPrompt]) -> dict[str, np.ndarray]:
        """See `Masker.masks`."""
        result = {name: np.zeros((frames.count, *frames.size), dtype=bool) for name in prompts}
        for step in (1, -1):
            previous: dict[str, _Last] = {}
            for frame in range(frames.count)[::step]:
                due = [name for name, prompt in prompts.items() if (frame - prompt.frame) * step >= 0]
                if not due:
                    continue
                part, count = self._parts(frames, frame)
                for name in due:
                    if frame == prompts[name].frame:
                        mask = _prompted(part, count, prompts[name])
                    else:
                        mask = self._followed(part, count, frames.depth[frame], previous.get(name), frame)
                    if mask.sum() >= self.cfg.min_pixels:
                        near, far = np.quantile(frames.depth[frame][mask], (0.05, 0.95))
                        largest = max(int(mask.sum()), previous[name].largest if name in previous else 0)
                        previous[name] = _Last(mask, frame, float(near), float(far), largest)
                        result[name][frame] = mask
        return result

    def _parts(self, frames: CameraFrames, frame: int) -> tuple[np.ndarray, int]:
        """Return the number of each pixel's part, shape (H, W), 0 for what is known, and how many numbers there are."""
        import cv2

        depth = frames.depth[frame].astype(np.float32)
        front = depth > 0
        if frames.known is not None:
            front &= depth < frames.known(frame) - self.cfg.foreground
        jump = np.zeros(depth.shape, dtype=bool)
        jump[:, 1:] |= (np.abs(np.diff(depth, axis=1)) > self.cfg.depth_jump) & front[:, 1:] & front[:, :-1]
        jump[1:] |= (np.abs(np.diff(depth, axis=0)) > self.cfg.depth_jump) & front[1:] & front[:-1]
        count, part = cv2.connectedComponents((front & ~jump).astype(np.uint8), connectivity=4)
        return part, count

    def _followed(self, part: np.ndarray, count: int, depth: np.ndarray, last: _Last | None, frame: int) -> np.ndarray:
        """Return the mask in a frame from where the object was seen last."""
        import cv2

        if last is None:
            return np.zeros(part.shape, dtype=bool)
        gap = abs(frame - last.frame)
        reach = max(1, round(gap * self.cfg.reach * part.shape[1] / 640))
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        around = cv2.dilate(last.mask.astype(np.uint8), kernel) > 0
        around &= (depth > last.near - gap * self.cfg.depth_reach) & (depth < last.far + gap * self.cfg.depth_reach)
        chosen = _parts_mostly_in(part, count, around) & around
        # What covered a part of the object has gone: all of what its mask lies on is the object, if that is no larger.
        total, inside = np.bincount(part.ravel(), minlength=count), np.bincount(part[last.mask], minlength=count)
        whole = (inside > SAME_PART * last.mask.sum()) & (total < self.cfg.max_growth * last.largest)
        whole[0] = False
        return chosen | whole[part]


def _prompted(part: np.ndarray, count: int, prompt: MaskPrompt) -> np.ndarray:
    """Return the mask of the parts that a prompt lies on."""
    height, width = part.shape

    def numbers(pixels: np.ndarray) -> np.ndarray:
        column, row = np.round(np.asarray(pixels, float).reshape(-1, 2)).astype(int).T
        return part[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]

    box = np.ones(part.shape, dtype=bool)
    if prompt.box is not None:
        left, top, right, bottom = prompt.box
        rows, columns = np.arange(height)[:, None], np.arange(width)
        box = (rows >= top - 0.5) & (rows <= bottom + 0.5) & (columns >= left - 0.5) & (columns <= right + 0.5)
    chosen = np.isin(part, numbers(prompt.points)) if len(prompt.points) else _parts_mostly_in(part, count, box)
    return chosen & box & (part > 0) & ~np.isin(part, numbers(prompt.outside))


def _parts_mostly_in(part: np.ndarray, count: int, region: np.ndarray) -> np.ndarray:
    """Return the pixels of the parts of which most lies in a region (H, W)."""
    total = np.bincount(part.ravel(), minlength=count)
    inside = np.bincount(part[region], minlength=count)
    chosen = inside > SAME_PART * np.maximum(total, 1)
    chosen[0] = False
    return chosen[part]
