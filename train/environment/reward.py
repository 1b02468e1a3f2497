"""Regularisation and engineered terms of the reward (paper, appendices C and G); the others are Warp kernels."""

from __future__ import annotations

import torch

from concent_warp.train.cfg import EngineeredCfg, RewardCfg
from concent_warp.train.environment.quaternions import (
    invert_quaternion,
    multiply_quaternions,
    rotate_vectors,
    rotation_angle,
)


def effort_penalties(
    cfg: RewardCfg, action: torch.Tensor, velocity: torch.Tensor, lead: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """Return the penalties of action, joint velocity and command lead, each at most 0, shape (N,).

    Args:
        cfg: Weights.
        action: Shape (N, A).
        velocity: Of the arm's joints [rad/s], shape (N, J).
        lead: Difference of command and joint position, relative to the largest allowed, shape (N, J).
    """
    terms = ((cfg.action, action), (cfg.velocity, velocity), (cfg.press, lead))
    return tuple(-weight * values.square().sum(dim=1) for weight, values in terms)


def relative_pose(
    position: torch.Tensor, quaternion: torch.Tensor, origin: torch.Tensor, turn: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return poses relative to the frames (origin, turn): positions (..., 3) [m] and quaternions (..., 4)."""
    back = invert_quaternion(turn)
    return rotate_vectors(back, position - origin), multiply_quaternions(back, quaternion)


def disturbance_penalty(
    cfg: RewardCfg,
    before: tuple[torch.Tensor, torch.Tensor],
    after: tuple[torch.Tensor, torch.Tensor],
) -> torch.Tensor:
    """Return the penalty of displacement and rotation of O objects between two steps, at most 0, shape (N,).

    Poses are positions (N, O, 3) [m] and quaternions (N, O, 4): relative to the hand where the stage grasps an object,
    otherwise in the world.
    """
    moved = torch.linalg.norm(after[0] - before[0], dim=-1)
    turned = rotation_angle(multiply_quaternions(invert_quaternion(before[1]), after[1]))
    return -(cfg.disturb_position * moved + cfg.disturb_rotation * turned).sum(dim=1)


def _two_scales(distance: torch.Tensor, far: tuple[float, float], near: tuple[float, float]) -> torch.Tensor:
    """Return A_f exp(-d / sigma_f) + A_n exp(-d / sigma_n) of distances [m], shape of `distance`."""
    return far[0] * torch.exp(-distance / far[1]) + near[0] * torch.exp(-distance / near[1])


def engineered_reward(cfg: EngineeredCfg, place: torch.Tensor) -> torch.Tensor:
    """Return the engineered insertion reward r^align-xy + r^depth-z + r^success (paper, appendix G), shape (N,).

    Args:
        cfg: Scales and weights.
        place: Origin of object 1 in the frame of object 2 [m], shape (N, 3); its z is the direction of insertion.
    """
    # Python numbers, since a copy of a tensor to the device cannot be captured in a CUDA graph.
    aside = torch.hypot(place[:, 0] - cfg.hole[0], place[:, 1] - cfg.hole[1])
    above = (place[:, 2] - cfg.seat).clamp(min=0)
    gate = torch.sigmoid((cfg.gate - aside) / cfg.gate_width)
    seated = (aside < cfg.reached) & (above <= 0)
    return _two_scales(aside, cfg.far, cfg.near) + gate * _two_scales(above, cfg.far, cfg.near) + cfg.bonus * seated
