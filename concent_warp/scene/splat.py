"""Gaussian splats: the reader of the 3DGS ``.ply`` format (Kerbl et al., "3D Gaussian Splatting", 2023)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from concent_warp.errors import SceneError
from concent_warp.scene.cloud import without_outliers
from concent_warp.scene.ply import PlyHeader, read_vertices

HARMONIC = 0.28209479177387814
"""Value of the constant spherical harmonic, ``1 / (2 sqrt(pi))``."""
NEEDED = ("x", "y", "z", "opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4)))
"""Properties without which a file holds no splats."""


@dataclass(frozen=True)
class GaussianSplats:
    """N Gaussians."""

    mean: np.ndarray
    """Centres [unit of the file; m after `scaled` to metres], shape (N, 3)."""
    scale: np.ndarray
    """Standard deviations along the Gaussian's own axes [as `mean`], shape (N, 3)."""
    rotation: np.ndarray
    """Unit quaternions wxyz from the Gaussian's axes to the file's frame, shape (N, 4)."""
    opacity: np.ndarray
    """Opacity [0 to 1], shape (N,)."""
    rgb: np.ndarray
    """Colour without view dependence [0 to 1, not clipped], shape (N, 3); grey where the file has none."""

    def __len__(self) -> int:
        return len(self.opacity)

    def scaled(self, factor: float) -> GaussianSplats:
        """Return a copy with lengths multiplied by `factor` [-]."""
        return GaussianSplats(factor * self.mean, factor * self.scale, self.rotation, self.opacity, self.rgb)

    def surface_points(self, opacity: float = 0.5) -> np.ndarray:
        """Return the centres of the Gaussians that stand for the surface, shape (n, 3).

        Faint Gaussians, below `opacity`, and floaters, far from all others, are left out.
        """
        points = self.mean[self.opacity >= opacity]
        return points[without_outliers(points)] if len(points) > 1 else points


def is_splats(header: PlyHeader) -> bool:
    """Tell whether a PLY file holds splats, by its vertex properties."""
    return set(NEEDED) <= header.properties("vertex")


def read_splats(path: Path) -> GaussianSplats:
    """Read a 3DGS ``.ply``: opacities are logits, scales logarithms, quaternions not normalised.

    Raises `SceneError` where the file is broken or holds no splats.
    """
    values = read_vertices(path)
    if missing := [name for name in NEEDED if name not in values]:
        raise SceneError("the PLY file holds no Gaussian splats", where=path, expected=NEEDED, found=f"no {missing}")

    def columns(*names: str) -> np.ndarray:
        return np.stack([values[name] for name in names], axis=1)

    mean = columns("x", "y", "z")
    log_scale = columns("scale_0", "scale_1", "scale_2")
    rotation = columns("rot_0", "rot_1", "rot_2", "rot_3")
    length = np.linalg.norm(rotation, axis=1)
    bad = ~np.isfinite(np.column_stack([mean, log_scale, rotation, values["opacity"]])).all(axis=1)
    bad |= (length < 1e-12) | (log_scale > 50).any(axis=1)
    if bad.any():
        raise SceneError(
            "splats with values that are not finite, or without a rotation", where=path,
            found=f"{int(bad.sum())} of {len(bad)}, the first at {int(np.argmax(bad))}",
        )  # fmt: skip
    colour = ("f_dc_0", "f_dc_1", "f_dc_2")
    has_colour = set(colour) <= set(values)
    return GaussianSplats(
        mean=mean,
        scale=np.exp(log_scale),
        rotation=rotation / length[:, None],
        opacity=1 / (1 + np.exp(-np.clip(values["opacity"], -500, 500))),
        rgb=HARMONIC * columns(*colour) + 0.5 if has_colour else np.full((len(mean), 3), 0.5),
    )
