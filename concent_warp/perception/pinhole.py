"""A calibrated camera: world points to pixels and depths, and back.

Camera axes are x right, y down, z forward; pixel coordinates are (column, row) with (0, 0) at the centre of the first
pixel, as in OpenCV; depth is measured along z, not along the ray.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from concent_warp.recording.recording import ImageStream


@dataclass(frozen=True)
class Pinhole:
    """Pinhole camera without distortion."""

    intrinsics: np.ndarray
    """Pinhole matrix [px], shape (3, 3)."""
    pose: np.ndarray
    """Camera-to-world transform, shape (4, 4)."""

    @staticmethod
    def of(stream: ImageStream) -> Pinhole:
        """Return the camera that took a stream."""
        return Pinhole(np.asarray(stream.intrinsics, float), np.asarray(stream.pose, float))

    @property
    def position(self) -> np.ndarray:
        """Centre of projection [m], world frame, shape (3,)."""
        return self.pose[:3, 3]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels [px], shape (..., 2), and depths [m], shape (...), of world points [m], shape (..., 3).

        Points behind the camera have a depth below 0, and their pixels are undefined.
        """
        local = (points - self.position) @ self.pose[:3, :3]
        image = local @ self.intrinsics.T
        with np.errstate(divide="ignore", invalid="ignore"):
            return image[..., :2] / image[..., 2:], local[..., 2]

    def lift(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Return the world points [m], shape (..., 3), at pixels [px], shape (..., 2), and depths [m], shape (...)."""
        return self.position + np.asarray(depth)[..., None] * (self.rays(pixels) @ self.pose[:3, :3].T)

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Return the viewing rays of pixels (..., 2) [px], camera frame, scaled to a depth of 1, shape (..., 3)."""
        ones = np.ones((*np.shape(pixels)[:-1], 1))
        return np.concatenate([pixels, ones], axis=-1) @ np.linalg.inv(self.intrinsics).T


def pixel_grid(height: int, width: int) -> np.ndarray:
    """Return the coordinates (column, row) [px] of all pixels of an image, shape (height, width, 2)."""
    return np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float)), axis=-1)
