"""The objective of the paper's equation 1: the Chamfer distance between observed and simulated point clouds.

All candidates and all segments run as parallel variants of one model. On CUDA the rollout, the predicted clouds and the
distances stay on the device; one number per candidate comes back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from concent_warp.fit.target import BodyTarget, Segment
from concent_warp.simulate.engine import Engine, Rollout, Variants
from concent_warp.simulate.replay import bracketing

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


class Objective:
    """Evaluates candidate geometries on segments of recordings."""

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

    def __call__(self, candidates: Candidates) -> Losses:
        """Return the losses of P candidates."""
        return self.losses(self.simulate(candidates), len(candidates.position))

    def simulate(self, candidates: Candidates) -> Rollout:
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
        ctrl = self.ctrl[0] if n == 1 else np.tile(self.ctrl, (count, 1, 1))
        self.simulations += count * n
        return self.engine.run(variants, ctrl, record=self.record, bodies=self.bodies)

    def losses(self, rollout: Rollout, count: int) -> Losses:
        """Return the losses of `count` candidates from a rollout of candidates times segments."""
        import torch

        n = len(self.segments)
        fit, held = [], []
        for s, segment in enumerate(self.segments):
            for target in segment.targets:
                distance, counted = self.distances(rollout, slice(s, None, n), target)
                if segment.held_out is not None:
                    (held if segment.held_out else fit).append(distance[:, counted].mean(dim=1))
                    continue
                out = torch.as_tensor(target.held_out(self.held_out, self.block), device=distance.device)
                keep = counted & ~out
                fit.append(distance[:, keep].mean(dim=1))
                held.append(distance[:, counted & out].mean(dim=1) if bool((counted & out).any()) else fit[-1])
        fit, held = fit or held, held or fit
        diverged = torch.as_tensor(rollout.diverged).reshape(count, n).any(dim=1)
        both = torch.stack([torch.stack(fit).mean(dim=0), torch.stack(held).mean(dim=0)])
        both = torch.where(diverged | ~torch.isfinite(both), torch.inf, both).cpu().numpy().astype(float)
        return Losses(both[0], both[1])

    def distances(self, rollout: Rollout, variants: slice, target: BodyTarget) -> tuple[torch.Tensor, torch.Tensor]:
        """Return Chamfer distances [m], shape (P, T), and which frames have points at all, shape (T,)."""
        import torch

        from concent_warp.kernels.chamfer import chamfer

        position, quaternion = torch.as_tensor(rollout.body_position), torch.as_tensor(rollout.body_quaternion)
        body = rollout.bodies.index(target.body)
        position, quaternion = position[variants, :, body], quaternion[variants, :, body]
        steps = int(self.ctrl.shape[1])
        lower, weight = self.rows(target.time, rollout.step, steps)
        lower, weight = torch.as_tensor(lower, device=position.device), torch.as_tensor(weight).to(position)
        anchor = torch.as_tensor(target.anchor).to(position)
        cloud = carried(anchor, position, quaternion)
        predicted = torch.lerp(cloud[:, lower], cloud[:, lower + 1], weight[None, :, None, None]).float()
        observed = torch.as_tensor(target.points, dtype=torch.float32, device=predicted.device)
        seen = torch.isfinite(observed).all(dim=2)
        shared = seen.expand(len(predicted), *seen.shape).contiguous()
        distance = chamfer(predicted, observed.nan_to_num(), shared, seen, squared=self.squared)
        return distance, seen.any(dim=1)

    def rows(self, time: np.ndarray, recorded: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the record row before each time, and the share of the next one."""
        position = np.clip(time / self.engine.timestep, 0, steps)
        floor = np.minimum(np.floor(position + 1e-9).astype(int), steps - 1)
        return np.searchsorted(recorded, floor), np.clip(position - floor, 0.0, 1.0)


def carried(anchor: torch.Tensor, position: torch.Tensor, quaternion: torch.Tensor) -> torch.Tensor:
    """Return points carried by poses: anchor (M, 3), position (..., 3), quaternion wxyz (..., 4) -> (..., M, 3)."""
    import torch

    w, axis = quaternion[..., None, :1], quaternion[..., None, 1:].expand(*quaternion.shape[:-1], len(anchor), 3)
    points = anchor.expand_as(axis)
    turn = 2 * torch.linalg.cross(axis, points)
    return position[..., None, :] + points + w * turn + torch.linalg.cross(axis, turn)
