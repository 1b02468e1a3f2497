"""Gaussian splats as torch tensors: the looks of an object, read from and written to the 3DGS ``.ply`` format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from concent_warp.errors import RenderError
from concent_warp.scene.shapes.splat import GaussianSplats, read_splats, write_splats
from concent_warp.scene.spheres.sampling import farthest_point_sampling

COEFFICIENTS = (1, 4, 9, 16)
"""Coefficients of spherical harmonics of degrees 0 to 3."""


@dataclass(frozen=True)
class Splats:
    """N Gaussians in the frame of their object."""

    means: torch.Tensor
    """Centres [m], shape (N, 3)."""
    quats: torch.Tensor
    """Quaternions wxyz from the Gaussian's axes to the object's frame, not necessarily of unit length, shape (N, 4)."""
    scales: torch.Tensor
    """Standard deviations along the Gaussian's own axes [m], shape (N, 3)."""
    opacities: torch.Tensor
    """Opacities [0 to 1], shape (N,)."""
    harmonics: torch.Tensor
    """Coefficients of the colour's spherical harmonics, shape (N, K, 3), K = 1, 4, 9 or 16 for degrees 0 to 3. The
    colour is their sum plus 0.5, not below 0."""

    def __post_init__(self) -> None:
        count, coefficients = len(self.means), self.harmonics.shape[1:2]
        shapes = [tuple(t.shape) for t in self.tensors()]
        if coefficients[0] not in COEFFICIENTS or shapes != [
            (count, 3), (count, 4), (count, 3), (count,), (count, *coefficients, 3)
        ]:  # fmt: skip
            raise RenderError(
                "splats of shapes that do not belong together",
                expected=f"(N, 3), (N, 4), (N, 3), (N,) and (N, K, 3) with K among {COEFFICIENTS}",
                found=", ".join(map(str, shapes)),
            )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return COEFFICIENTS.index(self.harmonics.shape[1])

    def tensors(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return means, quats, scales, opacities and harmonics."""
        return self.means, self.quats, self.scales, self.opacities, self.harmonics

    def to(self, device: str | torch.device) -> Splats:
        """Return the splats on a device."""
        return Splats(*(t.to(device) for t in self.tensors()))

    def select(self, which: torch.Tensor) -> Splats:
        """Return some of the splats, by a mask (N,) or by indices."""
        return Splats(*(t[which] for t in self.tensors()))

    def scaled(self, factor: float) -> Splats:
        """Return a copy with lengths multiplied by `factor` [-], say to metres."""
        means, quats, scales, opacities, harmonics = self.tensors()
        return Splats(factor * means, quats, factor * scales, opacities, harmonics)

    def spread(self, count: int) -> torch.Tensor:
        """Return indices of splats that lie far from each other, shape (count,).

        Density of trained splats follows the pattern on a surface; farthest point sampling evens it out, for contact
        spheres as for a coarser model (paper, appendix E).
        """
        chosen = farthest_point_sampling(self.means.detach().cpu().double().numpy(), count)
        return torch.from_numpy(chosen.astype(np.int64)).to(self.means.device)

    @staticmethod
    def read(path: Path | str, *, scale: float = 1.0, device: str | torch.device = "cpu") -> Splats:
        """Read a 3DGS ``.ply``, with a factor from the file's unit to metres.

        Raises `SceneError` where the file is missing, broken or has no splats.
        """
        read = read_splats(Path(path)).scaled(scale)
        values = (read.mean, read.rotation, read.scale, read.opacity, read.harmonics)
        return Splats(*(torch.tensor(v, dtype=torch.float32, device=device) for v in values))

    def write(self, path: Path | str) -> None:
        """Write a 3DGS ``.ply``, in one piece or not at all."""
        means, quats, scales, opacities, harmonics = (t.detach().cpu().double().numpy() for t in self.tensors())
        write_splats(GaussianSplats(means, scales, quats, opacities, harmonics), Path(path))
