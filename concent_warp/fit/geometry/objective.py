"""The objective of the paper's equation 1: the Chamfer distance between observed and simulated point clouds.

All candidates and all segments run as parallel variants of one model. On CUDA the rollout, the predicted clouds and the
distances stay on the device; one number per candidate comes back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from concent_warp.estimation.object_tracks import BodyTarget, Segment
from concent_warp.simulate.engine import Contacts, Engine, Rollout, Variants
from concent_warp.simulate.replay import bracketing
from concent_warp.simulate.select import has_cuda

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class Candidates:
    """P candidate geometries; what is None is as in the model."""

    position: np.ndarray
    """Sphere centres [m], body frame, shape (P, S, 3)."""
    radius: np.ndarray | None = None
    """Radii [m], shape (P, S)."""
    friction: np.ndarray | None = None
    """Sliding friction [-], shape (P, S)."""


@dataclass(frozen=True)
class Losses:
    """Mean Chamfer distance [m] of P candidates; infinite where the simulation diverged."""

    fit: np.ndarray
    """Over the frames that the fit may use, shape (P,)."""
    held_out: np.ndarray
    """Over the frames kept from it, shape (P,); equal to `fit` where none is kept."""


@dataclass(frozen=True)
class TargetTensors:
    """One target of one segment as tensors on the device that computes the losses."""

    segment: int
    """Index of the segment."""
    body: int
    """Index of the body among those recorded."""
    anchor: torch.Tensor
    """The points in the body frame [m] and a 1, shape (M, 4)."""
    lower: torch.Tensor
    """Record before each frame, shape (T,) int."""
    weight: torch.Tensor
    """Share of the record after it, shape (T,)."""
    observed: torch.Tensor
    """Observed positions [m], zero where not seen, shape (T, M, 3) float32."""
    seen: torch.Tensor
    """Which points were seen, shape (T, M) bool."""
    fit: torch.Tensor | None
    """Frames that the fit may use, int; None where the segment is kept from it."""
    held: torch.Tensor | None
    """Frames kept from it, int; None where none of the segment's are."""


class Objective:
    """Evaluates candidate geometries on segments of recordings.

    Nothing here waits for the device but the reading of the losses: targets are put there once.
    """

    def __init__(
        self, engine: Engine, segments: list[Segment], *, held_out: float, block: float, squared: bool = False
    ) -> None:
        """Prepare the targets.

        Args:
            engine: Engine of the model that is fitted.
            segments: Stretches to simulate; their commands are padded to the longest by holding the last.
            held_out: Share of the frames kept from the fit, in blocks.
            block: Length of these blocks [s].
            squared: Use the squared form of the Chamfer distance.
        """
        self.engine, self.segments, self.squared = engine, segments, squared
        self.held_out, self.block = held_out, block
        steps = max(len(s.ctrl) for s in segments)
        self.ctrl = np.stack([np.pad(s.ctrl, ((0, steps - len(s.ctrl)), (0, 0)), mode="edge") for s in segments])
        times = np.concatenate([t.time for s in segments for t in s.targets])
        self.record, _, _ = bracketing(times, engine.timestep, steps)
        self.bodies = tuple(dict.fromkeys(t.body for s in segments for t in s.targets))
        self.simulations = 0
        self._aims: dict[tuple[torch.device, torch.dtype], list[TargetTensors]] = {}

    def __call__(self, candidates: Candidates) -> Losses:
        """Return the losses of P candidates."""
        return self.losses(self.simulate(candidates), len(candidates.position))

    def simulate(self, candidates: Candidates, contacts: Contacts = "none") -> Rollout:
        """Return a rollout of P candidates on each of n segments; variant p * n + s is candidate p on segment s."""
        count, n = len(candidates.position), len(self.segments)

        def repeated(value: np.ndarray | None) -> np.ndarray | None:
            return None if value is None else np.repeat(value, n, axis=0)

        variants = Variants(
            count * n,
            sphere_position=repeated(candidates.position),
            sphere_radius=repeated(candidates.radius),
            sphere_friction=repeated(candidates.friction),
            qpos=np.tile(np.stack([s.qpos for s in self.segments]), (count, 1)),
            qvel=np.tile(np.stack([s.qvel for s in self.segments]), (count, 1)),
        )
        self.simulations += count * n
        return self.engine.run(variants, self.ctrl, record=self.record, bodies=self.bodies, contacts=contacts)

    def losses(self, rollout: Rollout, count: int) -> Losses:
        """Return the losses of `count` candidates from a rollout of candidates times segments."""
        import torch

        # Clouds are compared on the graphics processor where there is one, wherever they were simulated.
        device = "cuda" if has_cuda() else None
        position = torch.as_tensor(rollout.body_position, device=device)
        quaternion = torch.as_tensor(rollout.body_quaternion, device=device)
        diverged = torch.as_tensor(rollout.diverged, device=device).reshape(count, -1).any(dim=1)
        both = torch.stack(self.means(position, quaternion))
        both = torch.where(diverged | ~torch.isfinite(both), torch.inf, both).cpu().numpy().astype(float)
        return Losses(both[0], both[1])

    def means(self, position: torch.Tensor, quaternion: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the losses of `Losses` as tensors, shape (P,) each, differentiable with respect to the poses.

        Args:
            position: Recorded origins of the bodies [m], shape (P * n, R, B, 3).
            quaternion: Their orientations, wxyz, shape (P * n, R, B, 4).
        """
        import torch

        fit, held = [], []
        for aim in self.aims(position.device, position.dtype):
            mine = slice(aim.segment, None, len(self.segments)), slice(None), aim.body
            distance = self.distances(position[mine], quaternion[mine], aim)
            for losses, frames in ((fit, aim.fit), (held, aim.held)):
                if frames is not None:
                    losses.append(distance[:, frames].mean(dim=1))
        fit, held = fit or held, held or fit
        return torch.stack(fit).mean(dim=0), torch.stack(held).mean(dim=0)

    def distances(self, position: torch.Tensor, quaternion: torch.Tensor, aim: TargetTensors) -> torch.Tensor:
        """Return Chamfer distances [m], shape (P, T).

        Args:
            position: Recorded origins of the target's body [m], shape (P, R, 3).
            quaternion: Its orientations, wxyz, shape (P, R, 4).
            aim: The target.
        """
        import torch

        from concent_warp.kernels.chamfer.distance import chamfer

        # Points are linear in the pose, so that is interpolated and not the larger clouds.
        pose = _transforms(position, quaternion)
        pose = torch.lerp(pose[:, aim.lower], pose[:, aim.lower + 1], aim.weight[None, :, None, None])
        predicted = (aim.anchor @ pose).float()
        return chamfer(predicted, aim.observed, aim.seen, aim.seen, squared=self.squared)

    def aims(self, device: torch.device, dtype: torch.dtype) -> list[TargetTensors]:
        """Return the targets on a device, where they stay."""
        key = device, dtype
        if key not in self._aims:
            self._aims[key] = [
                self.aim(s, target, device, dtype) for s, each in enumerate(self.segments) for target in each.targets
            ]
        return self._aims[key]

    def aim(self, segment: int, target: BodyTarget, device: torch.device, dtype: torch.dtype) -> TargetTensors:
        """Put a target on a device."""
        import torch

        lower, weight = self.rows(target.time, self.record, int(self.ctrl.shape[1]))
        seen = np.all(np.isfinite(target.points), axis=2)
        counted = np.any(seen, axis=1)
        fit = held = np.flatnonzero(counted)
        whole = self.segments[segment].held_out
        if whole is None:
            out = target.held_out(self.held_out, self.block)
            fit, held = np.flatnonzero(counted & ~out), np.flatnonzero(counted & out)
            held = held if len(held) else fit
        kind: dict[str, Any] = {"dtype": dtype, "device": device}
        return TargetTensors(
            segment=segment,
            body=self.bodies.index(target.body),
            anchor=torch.as_tensor(np.column_stack([target.anchor, np.ones(len(target.anchor))]), **kind),
            lower=torch.as_tensor(lower, device=device),
            weight=torch.as_tensor(weight, **kind),
            observed=torch.as_tensor(np.where(seen[..., None], target.points, 0), dtype=torch.float32, device=device),
            seen=torch.as_tensor(seen, device=device),
            fit=None if whole else torch.as_tensor(fit, device=device),
            held=None if whole is False else torch.as_tensor(held, device=device),
        )

    def rows(self, time: np.ndarray, recorded: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the record row before each time, and the share of the next one."""
        position = np.clip(time / self.engine.timestep, 0, steps)
        floor = np.minimum(np.floor(position + 1e-9).astype(int), steps - 1)
        return np.searchsorted(recorded, floor), np.clip(position - floor, 0.0, 1.0)


def _transforms(position: torch.Tensor, quaternion: torch.Tensor) -> torch.Tensor:
    """Return what brings points (x, y, z, 1) of a body into the world, from the right, shape (..., 4, 3).

    Args:
        position: Origin of the body [m], shape (..., 3).
        quaternion: Its orientation, wxyz, shape (..., 4).
    """
    import torch

    w, x, y, z = quaternion.unbind(-1)
    axes = (
        1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y),
        2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
        2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.cat([torch.stack(axes, dim=-1), position], dim=-1).unflatten(-1, (4, 3))
