"""Points followed by optical flow, without learnt weights.

Pyramidal Lucas and Kanade (Bouguet, "Pyramidal implementation of the affine Lucas Kanade feature tracker", 2001), as
OpenCV has it, with the forward-backward check of Kalal, Mikolajczyk and Matas, "Forward-backward error: automatic
detection of tracking failures", ICPR 2010. From frame to frame errors add up, so each point is also compared with its
first frame, from where the flow has brought it; where both agree, the latter counts.
"""

from __future__ import annotations

import numpy as np

from concent_warp.checks import check_settings
from concent_warp.perception.backends.cfg import FlowTrackerCfg
from concent_warp.perception.backends.protocols import CameraFrames, PixelTracks


class FlowTracker:
    """Point tracker by optical flow; points that are lost stay lost.

    Example:
        >>> import concent_warp as cw
        >>> import numpy as np
        >>> image = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
        >>> rgb = np.stack([np.roll(image, k, axis=1) for k in range(3)])
        >>> frames = cw.CameraFrames(rgb, np.zeros(rgb.shape[:3], np.float32))
        >>> tracks = cw.FlowTracker().track(frames, np.array([[0, 40.0, 30.0]]))
        >>> tracks.pixels[0, 2].round(1)
        array([42., 30.])
    """

    def __init__(self, cfg: FlowTrackerCfg | None = None) -> None:
        """Take settings."""
        self.cfg = cfg or FlowTrackerCfg()
        check_settings(self.cfg)

    def choose(self, frames: CameraFrames, frame: int, mask: np.ndarray, count: int) -> np.ndarray:
        """See `PointTracker.choose`: corners."""
        return corners(frames.rgb[frame], mask, count, self.cfg.spacing, self.cfg.quality)

    def track(self, frames: CameraFrames, queries: np.ndarray) -> PixelTracks:
        """See `PointTracker.track`."""
        count = len(queries)
        pixels = np.full((count, frames.count, 2), np.nan)
        visible = np.zeros((count, frames.count), dtype=bool)
        start = np.asarray(queries)[:, 0].astype(int)
        for first in np.unique(start):
            mine = np.flatnonzero(start == first)
            at = np.asarray(queries)[mine, 1:].astype(np.float32)
            pixels[mine, first], visible[mine, first] = at, True
            for order in (range(first + 1, frames.count), range(first - 1, -1, -1)):
                self._follow(frames, first, mine, at, order, pixels, visible)
        return PixelTracks(pixels, visible)

    def matched(
        self, first: np.ndarray, second: np.ndarray, points: np.ndarray, guess: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return where points are in another image from a guess of it, and whether the way back leads to them.

        Args:
            first: Image of the points, uint8, shape (H, W, 3).
            second: The other image.
            points: Pixels (column, row), shape (n, 2).
            guess: Where they are about [px], shape (n, 2).

        Returns:
            Pixels, shape (n, 2), and flags, shape (n,) bool.
        """
        return self._there_and_back(_grey(first), _grey(second), points, guess)

    def _follow(
        self,
        frames: CameraFrames,
        first: int,
        rows: np.ndarray,
        start: np.ndarray,
        order: range,
        pixels: np.ndarray,
        visible: np.ndarray,
    ) -> None:
        """Follow points (n, 2) of a frame through others and write them to the rows of the tracks."""
        origin = previous = _grey(frames.rgb[first])
        at, alive = start.copy(), np.ones(len(rows), dtype=bool)
        for frame in order:
            if not alive.any():
                return
            image = _grey(frames.rgb[frame])
            moved, good = self._there_and_back(previous, image, at, at)
            alive &= good
            anchored, sure = self._there_and_back(origin, image, start, moved)
            sure &= np.linalg.norm(anchored - moved, axis=1) < self.cfg.max_drift
            at = np.where(sure[:, None], anchored, moved).astype(np.float32)
            pixels[rows[alive], frame], visible[rows[alive], frame] = at[alive], True
            previous = image

    def _there_and_back(
        self, first: np.ndarray, second: np.ndarray, points: np.ndarray, guess: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return where points (n, 2) of one image are in another, and whether they come back, shape (n,) bool."""
        import cv2

        edge = 2 * self.cfg.half_window + 1
        options = {
            "winSize": (edge, edge),
            "maxLevel": self.cfg.levels,
            "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01),
            "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        }
        points, guess = np.ascontiguousarray(points), np.ascontiguousarray(guess, dtype=np.float32)
        there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, points, guess.copy(), **options)
        back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, there, points.copy(), **options)
        height, width = second.shape
        inside = ((there >= 0) & (there <= [width - 1, height - 1])).all(axis=1)
        near = np.linalg.norm(back - points, axis=1) < self.cfg.max_return_error
        return there, inside & near & (found.ravel() > 0) & (returned.ravel() > 0)


def corners(rgb: np.ndarray, mask: np.ndarray, count: int, spacing: float, quality: float) -> np.ndarray:
    """Return corners (column, row) of an image (H, W, 3), best first, within a mask (H, W), shape (n, 2)."""
    import cv2

    found = cv2.goodFeaturesToTrack(_grey(rgb), count, quality, spacing, mask=mask.astype(np.uint8), blockSize=5)
    return np.zeros((0, 2)) if found is None else found.reshape(-1, 2).astype(float)


def _grey(rgb: np.ndarray) -> np.ndarray:
    """Return the brightness of an image, uint8, shape (H, W)."""
    import cv2

    return cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY)
