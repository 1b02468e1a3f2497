"""Settings of the initial states of episodes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from concent_warp.checks import Bounds, Count, Duration, Positive, Share, Signed


@dataclass(frozen=True)
class PostureSolverCfg:
    """Inverse kinematics of one state by damped least squares from the demonstrated posture."""

    iterations: Count = 20
    """Largest number of iterations."""
    damping: float = 1e-4
    """Damping added to the diagonal of J J^T, with lengths in m and angles in rad."""
    position: float = 2e-4
    """Accepted position error [m], well below `ResetCfg.slip`."""
    angle: float = 2e-3
    """Accepted orientation error [rad]."""


@dataclass(frozen=True)
class NewtonSolverCfg:
    """Inverse kinematics of all states at once by Newton's Levenberg-Marquardt solver."""

    iterations: Count = 40
    """Number of iterations."""
    seeds: Annotated[int, Bounds(1, 10_000)] = 4
    """Initial postures per state, of which the best solution is kept."""
    noise: float = 0.1
    """Standard deviation of the further initial postures around the demonstrated one [rad or m]."""
    limit_weight: float = 10.0
    """Weight of the joint limits against position [1/m] and orientation [1/rad]."""
    position: float = 3e-4
    """Accepted position error [m]; larger than that of `PostureSolverCfg`, as the solver works in single precision."""
    angle: float = 3e-3
    """Accepted orientation error [rad]."""


@dataclass(frozen=True)
class StuckCfg:
    """States in which progress stopped during training, from which later episodes start."""

    share: Share = 0.2
    """Share of episodes that start from such a state when all episodes succeed; in proportion to the success rate."""
    after: Duration = 1.0
    """Time without progress after which a world is stuck [s]."""
    gain: float = 0.001
    """Decrease of the worst contact pair's distance that counts as progress [m]."""
    within: Positive = 0.06
    """Distance of the worst contact pair up to which a stuck state is stored [m]."""
    states: Count = 4096
    """Number of states that are kept, the latest."""


@dataclass(frozen=True)
class ResetCfg:
    """Initial states along the demonstration that keep the contact chain (paper, appendix D)."""

    states: Count = 2048
    """States sampled before training; each episode starts from one of them."""
    demonstrated: Share = 0.2
    """Share of states as demonstrated, without displacement."""
    position: float = 0.012
    """Half width of the horizontal displacement [m]."""
    lift: float = 0.015
    """Largest upward displacement of a grasped object [m]."""
    turn: float = 0.15
    """Half width of the rotation about the vertical [rad]."""
    grasp_turn: float = 0.3
    """Half width of the rotation of a grasped object in the hand about the axis between the fingers [rad]: the rotation
    that contact with an edge causes."""
    joints: float = 0.05
    """Half width of the displacement of the arm's joints where no object is grasped [rad or m]."""
    free: Share = 0.3
    """In chains of stages, share of initial states of the whole task: the robot as at the start of the demonstration,
    the objects anywhere. The others are shared equally among the stages."""
    along_path: Share = 0.5
    """In chains, share of states whose moments are uniform along the hand's path, the others' in time: a block is in
    the hole for a while and slides into it in a moment. From the first contact of the objects on, these states are as
    demonstrated relative to object 2."""
    place: tuple[float, float] = (0.05, 0.03)
    """In chains, half widths of the squares around the demonstrated positions of objects 1 and 2 [m]."""
    heading: tuple[float, float] = (0.5, 0.3)
    """In chains, half widths of the rotations of objects 1 and 2 about the vertical [rad]."""
    approach: float = 3.0
    """In chains, factor minus 1 by which the displacement of the hand is larger at the start of the approach to object
    1 than at its end."""
    before: Signed = 0.3
    """Time before the preceding stage from which states are sampled [s]; a negative one is after its start, where the
    stage itself begins at the latest."""
    settling_time: Annotated[float, Bounds(0, 3600)] = 0.1
    """Time for which a state is simulated with constant commands before it is accepted [s]."""
    slip: float = 0.003
    """Largest accepted motion of a grasped object in the hand during that time [m]."""
    overlap: float = 0.0015
    """Penetration of spheres of different objects above which a displaced state is discarded [m]."""
    passes: Count = 20
    """Largest number of candidates for each state, on average, after which sampling fails."""
    stuck: StuckCfg = field(default_factory=StuckCfg)
    """States in which progress stopped."""
    solver: Literal["auto", "newton", "posture"] = "auto"
    """Inverse kinematics: "posture" solves states one by one, some hundred a second; "newton" solves all at once, once
    its kernels are compiled, which takes 2 to 3 minutes on a GPU; "auto" takes "posture"."""
    posture_solver: PostureSolverCfg = field(default_factory=PostureSolverCfg)
    """Inverse kinematics of single poses."""
    newton_solver: NewtonSolverCfg = field(default_factory=NewtonSolverCfg)
    """Inverse kinematics of batches of poses."""
