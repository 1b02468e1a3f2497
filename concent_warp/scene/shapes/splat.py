"""Gaussian splats: reader and writer of the 3DGS ``.ply`` format (Kerbl et al., "3D Gaussian Splatting", 2023).

A file holds ``x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3``, opacities as logits, scales as
logarithms, quaternions wxyz. ``f_rest`` holds the spherical harmonics beyond the constant one, all of red, then all of
green, then all of blue: 9, 24 or 45 values for degrees 1 to 3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from concent_warp.errors import SceneError
from concent_warp.files import write_bytes
from concent_warp.scene.shapes.cloud import without_outliers
from concent_warp.scene.shapes.ply import PlyHeader, read_vertices

CONSTANT_HARMONIC = 0.28209479177387814
"""Value of the constant spherical harmonic, ``1 / (2 sqrt(pi))``."""
REQUIRED_PROPERTIES = ("x", "y", "z", "opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4)))
"""Properties without which a file holds no splats."""
DEGREES = {0: 0, 9: 1, 24: 2, 45: 3}
"""Degree of the harmonics by the number of ``f_rest`` properties."""
OPACITY_MARGIN = 1e-6
"""Opacities are written as if they kept this distance from 0 and 1, whose logits are not finite."""


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
    harmonics: np.ndarray
    """Coefficients of the colour's spherical harmonics, shape (N, K, 3), K = 1, 4, 9 or 16 for degrees 0 to 3; zero,
    which is grey, where the file has no colour."""

    @property
    def rgb(self) -> np.ndarray:
        """Colour without view dependence [0 to 1, not clipped], shape (N, 3)."""
        return CONSTANT_HARMONIC * self.harmonics[:, 0] + 0.5

    def __len__(self) -> int:
        return len(self.opacity)

    def scaled(self, factor: float) -> GaussianSplats:
        """Return a copy with lengths multiplied by `factor` [-]."""
        return replace(self, mean=factor * self.mean, scale=factor * self.scale)

    def surface_points(self, opacity: float = 0.5) -> np.ndarray:
        """Return the centres of the Gaussians that stand for the surface, shape (n, 3).

        Faint Gaussians, below `opacity`, and floaters, far from all others, are left out.
        """
        points = self.mean[self.opacity >= opacity]
        return points[without_outliers(points)] if len(points) > 1 else points


def is_splats(header: PlyHeader) -> bool:
    """Return whether a PLY file holds splats, by its vertex properties."""
    return set(REQUIRED_PROPERTIES) <= header.properties("vertex")


def read_splats(path: Path) -> GaussianSplats:
    """Read a 3DGS ``.ply``: opacities are logits, scales logarithms, quaternions not normalised.

    Raises `SceneError` where the file is broken or holds no splats.
    """
    values = read_vertices(path)
    if missing := [name for name in REQUIRED_PROPERTIES if name not in values]:
        raise SceneError(
            "the PLY file holds no Gaussian splats", where=path, expected=REQUIRED_PROPERTIES, found=f"no {missing}"
        )

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
    return GaussianSplats(
        mean=mean,
        scale=np.exp(log_scale),
        rotation=rotation / length[:, None],
        opacity=1 / (1 + np.exp(-np.clip(values["opacity"], -500, 500))),
        harmonics=_read_harmonics(values, path),
    )


def _read_harmonics(values: dict[str, np.ndarray], path: Path) -> np.ndarray:
    """Return the harmonics among the properties of a file, shape (N, K, 3); zeros where it has no colour."""
    constant = [f"f_dc_{k}" for k in range(3)]
    count = sum(name.startswith("f_rest_") for name in values)
    rest = [f"f_rest_{k}" for k in range(count)]
    if count not in DEGREES or not set(rest) <= set(values):
        raise SceneError(
            "the spherical harmonics are of no known degree", where=path, expected=f"f_rest_0.. of {sorted(DEGREES)}",
            found=f"{count} of them",
        )  # fmt: skip
    size = len(values["x"])
    if not set(constant) <= set(values):
        return np.zeros((size, 1, 3))
    table = np.stack([values[name] for name in (*constant, *rest)], axis=1)
    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        raise SceneError("splats with colours that are not finite", where=path, found=f"{int(bad.sum())} of {size}")
    return np.concatenate([table[:, None, :3], table[:, 3:].reshape(size, 3, -1).transpose(0, 2, 1)], axis=1)


def write_splats(splats: GaussianSplats, path: Path) -> None:
    """Write a binary 3DGS ``.ply`` in one piece or not at all; values are rounded to float32."""
    size, count = len(splats), 3 * (splats.harmonics.shape[1] - 1)
    opacity = np.clip(splats.opacity, OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    columns = {
        **{name: splats.mean[:, k] for k, name in enumerate("xyz")},
        **{f"n{name}": np.zeros(size) for name in "xyz"},
        **{f"f_dc_{k}": splats.harmonics[:, 0, k] for k in range(3)},
        **{f"f_rest_{k}": splats.harmonics[:, 1 + k % (count // 3), k // (count // 3)] for k in range(count)},
        "opacity": np.log(opacity / (1 - opacity)),
        **{f"scale_{k}": np.log(splats.scale[:, k]) for k in range(3)},
        **{f"rot_{k}": splats.rotation[:, k] for k in range(4)},
    }
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {size}\n"
    header += "".join(f"property float {name}\n" for name in columns) + "end_header\n"
    write_bytes(path, header.encode() + np.stack([*columns.values()], axis=1).astype("<f4").tobytes())
