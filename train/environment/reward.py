"""Terms of the reward that are plain arithmetic (paper, appendices C and G); the rest comes from kernels."""

from __future__ import annotations

import torch

from concent_warp.train.cfg import EngineeredCfg, RewardCfg
from concent_warp.train.environment.quaternions import angle, inverse, multiply, rotate


def effort(
    cfg: RewardCfg, action: torch.Tensor, velocity: torch.Tensor, lead: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """Return the penalties of what the arm does, each 0 or less, shape (N,).

    Args:
        cfg: Their weights.
        action: Shape (N, A).
        velocity: Of the arm's joints [rad/s], shape (N, J).
        lead: Of the commands over the joints, relative to the largest allowed, shape (N, J).
    """
    terms = ((cfg.action, action), (cfg.velocity, velocity), (cfg.press, lead))
    return tuple(-weight * values.square().sum(dim=1) for weight, values in terms)


def relative_pose(
    position: torch.Tensor, quaternion: torch.Tensor, origin: torch.Tensor, turn: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return poses in other frames: positions (..., 3) [m] and quaternions (..., 4) in the frames (origin, turn)."""
    back = inverse(turn)
    return rotate(back, position - origin), multiply(back, quaternion)


def disturbance(
    cfg: RewardCfg,
    before: tuple[torch.Tensor, torch.Tensor],
    after: tuple[torch.Tensor, torch.Tensor],
) -> torch.Tensor:
    """Return the penalty of moving and turning O objects between two steps, 0 or less, shape (N,).

    Poses are positions (N, O, 3) [m] and quaternions (N, O, 4): in the hand where the stage holds an object, in the
    world elsewhere.
    """
    moved = torch.linalg.norm(after[0] - before[0], dim=-1)
    turned = angle(multiply(inverse(before[1]), after[1]))
    return -(cfg.disturb_position * moved + cfg.disturb_rotation * turned).sum(dim=1)


def _two_scales(distance: torch.Tensor, far: tuple[float, float], near: tuple[float, float]) -> torch.Tensor:
    """Return A_f exp(-d / sigma_f) + A_n exp(-d / sigma_n) of distances [m], shape of `distance`."""
    return far[0] * torch.exp(-distance / far[1]) + near[0] * torch.exp(-distance / near[1])


def engineered(cfg: EngineeredCfg, place: torch.Tensor) -> torch.Tensor:
    """Return the engineered insertion reward r^align-xy + r^depth-z + r^success (paper, appendix G), shape (N,).

    Args:
        cfg: What was designed by hand.
        place: Origin of object 1 in the frame of object 2 [m], shape (N, 3); its z is the direction of insertion.
    """
    # Numbers, not a tensor made here: a copy to the device could not be captured in a graph.
    aside = torch.hypot(place[:, 0] - cfg.hole[0], place[:, 1] - cfg.hole[1])
    above = (place[:, 2] - cfg.seat).clamp(min=0)
    gate = torch.sigmoid((cfg.gate - aside) / cfg.gate_width)
    seated = (aside < cfg.reached) & (above <= 0)
    return _two_scales(aside, cfg.far, cfg.near) + gate * _two_scales(above, cfg.far, cfg.near) + cfg.bonus * seated
