"""Settings of what a policy observes, and of the errors of the instruments that it observes through."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from concent_warp.checks import Bounds, Duration, Share, Signed


@dataclass(frozen=True)
class SensorErrorsCfg:
    """Errors of the joint encoders and of the tracker of object poses.

    Example:
        >>> import concent_warp as cw
        >>> cw.SensorErrorsCfg(rate=60.0, position_std=5e-4).position_std
        0.0005
    """

    exact: bool = False
    """Whether the policy observes the exact state; the other settings do nothing then."""
    encoder_std: float = 2e-4
    """Standard deviation of a joint reading [rad or m]."""
    encoder_step: float = 1e-4
    """Step in which joint readings are quantised [rad or m]; 0 for none."""
    rate: Annotated[float, Bounds(1, 1000)] = 30.0
    """Frame rate of the tracker [Hz]."""
    position_std: float = 1e-3
    """Standard deviation of a tracked position per axis [m]."""
    orientation_std: float = 0.0175
    """Standard deviation of a tracked orientation per axis [rad]."""
    constant_share: Share = 0.25
    """Share of these variances that is the same for a whole episode, as of a wrong calibration; the rest is independent
    from frame to frame."""
    dropout: Share = 0.05
    """Share of frames in which an object is not found."""
    latency: Annotated[tuple[float, float], Bounds(0, 100, ascending=True)] = (1.0, 2.0)
    """Time from a frame to its pose [frames]; sampled once for each episode."""
    position_bias: tuple[Signed, Signed, Signed] = (0.0, 0.0, 0.0)
    """Error of every tracked position in all episodes [m], world frame, as of a wrongly calibrated camera."""
    orientation_bias: tuple[Signed, Signed, Signed] = (0.0, 0.0, 0.0)
    """Error of every tracked orientation in all episodes, a rotation vector [rad], world frame."""
    biased: tuple[str, ...] = ()
    """Objects that the last two settings concern; all where empty."""


@dataclass(frozen=True)
class ObservationCfg:
    """Observation of the policy (paper, table of appendix C)."""

    slots: Annotated[int, Bounds(1, 10_000)] = 8
    """Contact slots; of a stage with more demonstrated pairs, those with the widest spread are kept."""
    leads: bool = True
    """Whether the policy observes how far the arm's commands lead its joints, which with the stiffness are the forces
    that it exerts. The paper's observation lacks them."""
    history: Annotated[int, Bounds(1, 100)] = 1
    """Control steps that the policy observes at once, the latest first."""
    sensors: SensorErrorsCfg = field(default_factory=SensorErrorsCfg)
    """Errors of the instruments in training."""
    smoothing: Duration = 0.15
    """Time constant with which tracked poses are averaged [s]: of grasped objects in the hand, of others in the world.
    A longer one averages more noise away and notices a slip later. Fixed objects are averaged over the episode."""
