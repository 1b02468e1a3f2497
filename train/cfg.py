"""Everything that can be set about a training: one tree of plain data, on the command line and beside every run."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, is_dataclass
from pathlib import Path
from typing import Any, Literal

from concent_warp.errors import ConcentError, TrainError
from concent_warp.events.decode import decode
from concent_warp.files import write_text

Range = tuple[float, float]
ALL = "all"
"""Name of the chain of all stages."""
SINGLE, CHAINED = 3.0, 12.0
"""Lengths of episodes of one stage and of a chain of them, where none is given [s]."""
SETTINGS = "train.toml"
"""File of the resolved configuration in a run folder."""


@dataclass(frozen=True)
class ActionCfg:
    """What an action does: steps of the commands, each number in -1..1 a share of the largest step."""

    gripper_actuators: tuple[str, ...] = ("gripper",)
    """Actuators that open and close the gripper with one number; those that the scene lacks are passed over."""
    tool_site: str = "tcp"
    """Site between the fingertips: the end-effector."""
    turn: float = 0.02
    """Largest step of a hinge joint's command [rad]."""
    slide: float = 0.004
    """Largest step of a slide joint's command [m]."""
    gripper: float = 0.003
    """Largest step of the gripper's command [m]: small enough that exploring does not drop what is held at once."""
    turn_lead: float = 0.03
    """How far a hinge joint's command may run ahead of the joint [rad]: with the stiffness, the largest force."""
    slide_lead: float = 0.015
    """The same for slide joints [m]."""


@dataclass(frozen=True)
class ObservationCfg:
    """What the policy sees (paper, table of appendix C)."""

    slots: int = 8
    """Contact slots; a stage with more demonstrated pairs keeps those spread most widely."""
    noise: float = 0.0
    """Standard deviation of the noise on object positions [m]."""


@dataclass(frozen=True)
class EngineeredCfg:
    """The engineered insertion reward (paper, appendix G): what has to be designed by hand for each task."""

    hole: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of the hole in the frame of object 2 [m]."""
    seat: float = 0.0235
    """Height of object 1 above object 2's origin at which it counts as fully seated [m]."""
    far: Range = (1.0, 0.1)
    """Amplitude and length scale [m] of the wide term, of alignment and depth alike."""
    near: Range = (1.0, 0.01)
    """Amplitude and length scale [m] of the narrow term."""
    gate: float = 0.03
    """Horizontal distance at which the depth term turns on [m]."""
    gate_width: float = 0.005
    """Width of the gate [m]."""
    reached: float = 0.01
    """Horizontal distance within which the bonus is given [m]."""
    bonus: float = 50.0
    """Bonus of every step in which the object is seated."""


@dataclass(frozen=True)
class RewardCfg:
    """Weights and scales of the reward (paper, section 3.2.1 and appendix C)."""

    kind: Literal["contact", "engineered"] = "contact"
    """The contact-event reward, or the engineered one as a baseline."""
    reach: float = 1.0
    """Weight of the reaching term."""
    regularisation: float = 1.0
    """Weight of the regularisation."""
    vcp: float = 1.0
    """Weight of the virtual collision penalty."""
    far: Range = (1.0, 0.05)
    """Amplitude and length scale [m] of the far reaching term."""
    near: Range = (2.0, 0.008)
    """Amplitude and length scale [m] of the near reaching term."""
    wide: Range = (1.0, 0.3)
    """The same of a third term, for the way to an object; given where stages are chained."""
    stage: float = 5.0
    """Reward of a step for each stage that is done: more than reaching can give, so that moving on is always better."""
    action: float = 0.01
    """Penalty of the squared action."""
    velocity: float = 0.001
    """Penalty of the squared arm joint velocity [s^2/rad^2]."""
    press: float = 0.0
    """Penalty of the squared lead of a joint's command over the joint, relative to the largest allowed: of force and
    haste."""
    disturb_position: float = 2.0
    """Penalty of moving an object between steps [1/m]: in the hand where the stage holds it, else in the world."""
    disturb_rotation: float = 1.0
    """The same for turning it [1/rad]."""
    failure: float = 5.0
    """Fixed penalty of an episode that ends in failure."""
    lenience: float = 0.0
    """Share of the penalties of virtual collisions and failure that counts while no episode succeeds; it rises to 1
    with the square of the share of those that do. Large penalties that count from the start keep a policy away from its
    target."""
    scale: float = 0.05
    """Factor on all of it, so that values are of order 1, which the value function learns sooner; divided by the number
    of stages that are chained."""
    engineered: EngineeredCfg = field(default_factory=EngineeredCfg)


@dataclass(frozen=True)
class CollisionCfg:
    """The virtual collision penalty (paper, section 3.2.2)."""

    margin: float = 0.002
    """Distance below which spheres outside the physics are penalised [m]."""
    severe: float = 0.004
    """Penetration of one of them that ends the episode [m]."""
    slack: float = 0.0005
    """How deep contacts of the physics are, too: left-out spheres are taken to be smaller by so much [m]."""
    depth: float = 50.0
    """Penalty of a penetration [1/m], summed over the spheres. Too little, and the policy learns to go through what the
    physics leaves out."""
    points: int = 512
    """Points on the surface of each object that are to keep out of the other objects as well: spheres round off edges,
    and what is learnt with these points holds up where edges are sharp."""
    band: float = 0.01
    """Penalty of a sphere in touch, falling to 0 at the margin."""
    threads: int = 128
    """Threads of a GPU that share a world's spheres."""


@dataclass(frozen=True)
class ResetCfg:
    """Initial states along the demonstration, the contact chain kept (paper, appendix D)."""

    states: int = 2048
    """States drawn before training, of which each episode takes one."""
    demonstrated: float = 0.2
    """Share of states as demonstrated, without displacement."""
    before: float = 0.3
    """How long before the preceding stage states are taken from [s]."""
    position: float = 0.012
    """Half width of the horizontal displacement [m]."""
    lift: float = 0.015
    """Largest upward displacement of what is held [m]."""
    turn: float = 0.15
    """Half width of the rotation about the vertical [rad]."""
    held: float = 0.15
    """Half width of the rotation of a held object in the hand, about the axis along which it is held [rad]: an edge
    that catches turns it there, and a policy is to know what to do then."""
    solver: Literal["auto", "newton", "posture"] = "auto"
    """Inverse kinematics: all states at once by Newton, from several seeds, or one after the other from the
    demonstrated posture; "auto" takes Newton on a GPU (on a CPU its kernels take a minute to compile)."""
    joints: float = 0.05
    """Half width of the displacement of the arm's joints where nothing is held [rad or m]."""
    settle: float = 0.1
    """Time for which a state is simulated, the commands held, before it may be used [s]."""
    slip: float = 0.003
    """How far an object may move in the hand while settling [m]."""
    overlap: float = 0.0015
    """Penetration of spheres of different objects at which a displaced state is discarded [m]."""
    free: float = 0.3
    """Share of states at the very beginning, where stages are chained: the robot as at the start of the demonstration,
    the objects anywhere. The others are shared equally among the stages."""
    place: tuple[float, float] = (0.05, 0.03)
    """Half widths of the squares about the demonstrated places in which objects 1 and 2 are put in a chain [m]."""
    heading: tuple[float, float] = (0.5, 0.3)
    """Half widths of their rotations about the vertical in a chain [rad]."""


@dataclass(frozen=True)
class ChainCfg:
    """When a world moves on to the next stage, and when its episode is over."""

    tolerance: float = 0.004
    """Distance within which all contact pairs of a target event are to be [m]."""
    hold: int = 2
    """Control steps for which they are to be there."""
    rest: float = 0.5
    """Time for which object 1 has been in place when an episode of a chain ends [s]."""


@dataclass(frozen=True)
class RandomisationCfg:
    """What differs between the worlds; it is drawn once for each world."""

    friction: Range = (1.0, 1.0)
    """Factor on the sliding friction of all geoms but the robot's."""
    grip: Range = (1.0, 1.0)
    """Factor on the sliding friction of the robot's geoms. What is held has the larger friction of the two."""
    stiffness: Range = (1.0, 1.0)
    """Factor on the stiffness of the position control."""
    damping: Range = (1.0, 1.0)
    """Factor on the damping of the joints."""
    mass: Range = (1.0, 1.0)
    """Factor on mass and inertia of the objects."""
    joint_friction: Range = (0.0, 0.0)
    """Dry friction of the joint with the strongest drive [N m or N]; less in the others, as their drives are weaker."""
    delay: Range = (0.0, 0.0)
    """Delay of the arm's commands [s]."""
    lag: Range = (0.0, 0.0)
    """Time constant with which the arm's set points follow its commands [s]."""
    push: tuple[float, float] = (0.0, 0.0)
    """Standard deviations of a force [N] and of a torque [N m], each along any direction, that act on object 1 for the
    length of an action now and then, where the stage holds it: it is turned in the hand, or knocked out of the way, and
    the policy learns what to do then. Not in an evaluation."""
    push_share: float = 0.2
    """Share of the actions in which they act."""


@dataclass(frozen=True)
class EnvironmentCfg:
    """The vectorised environment.

    Example:
        >>> import concent_warp as cw
        >>> cw.EnvironmentCfg(stage="insert", worlds=4096).worlds
        4096
    """

    worlds: int = 4096
    """Environments side by side."""
    engine: Literal["auto", "warp", "mujoco"] = "auto"
    """MuJoCo-Warp or C MuJoCo; "auto" takes MuJoCo-Warp on a GPU and C MuJoCo on a CPU."""
    stage: str = "insert"
    """Stage of the contact event sequence whose target event is trained; "all" chains all stages."""
    collision: Literal["vcp", "full"] = "vcp"
    """Spheres in the physics: those of the contact event sequence alone, or all."""
    decimation: int = 10
    """Time steps of the model in one action."""
    stride: int = 1
    """How many of those a simulation step takes at once: coarser physics, in less time. Contacts want steps of half
    their time constant at most."""
    episode: float | None = None
    """Length of an episode [s]; by default 3 s, where stages are chained 12 s."""
    dropped: float = 0.02
    """Distance of a contact pair with the robot at which a held object counts as lost [m]."""
    lost: float = 1.0
    """Distance between objects 1 and 2 at which an episode ends, for one of them has been knocked away [m]."""
    success: float = 0.003
    """Largest deviation, per axis, of object 1 from its demonstrated place in object 2 that counts as success [m]."""
    capture: Literal["none", "physics", "step"] = "step"
    """What is captured in CUDA graphs: nothing, the physics, or all of a step."""
    fuse: bool = False
    """Compile what torch does in a captured step into few kernels: quicker steps for some time at the start."""
    nconmax: int | None = None
    """Contacts a world to make room for; by default measured on the demonstration."""
    njmax: int | None = None
    """Constraint rows a world to make room for; by default measured on the demonstration."""
    solver_iterations: int | None = None
    """Most iterations of the solver in a simulation step; by default the model's."""
    ls_iterations: int | None = None
    """Most iterations of its line search; by default the model's."""
    cone: Literal["auto", "elliptic", "pyramidal"] = "auto"
    """Friction cones; "auto" as the model has them. Pyramids are quicker; friction is weaker between their axes than
    along them, and what is held slips more."""
    jacobian: Literal["auto", "dense", "sparse"] = "auto"
    """How the solver keeps the constraints' derivatives: the same results, at other speeds; "auto" as MuJoCo does."""
    action: ActionCfg = field(default_factory=ActionCfg)
    observation: ObservationCfg = field(default_factory=ObservationCfg)
    reward: RewardCfg = field(default_factory=RewardCfg)
    virtual: CollisionCfg = field(default_factory=CollisionCfg)
    reset: ResetCfg = field(default_factory=ResetCfg)
    chain: ChainCfg = field(default_factory=ChainCfg)
    randomisation: RandomisationCfg = field(default_factory=RandomisationCfg)
    randomise_effects: bool = True
    """Draw the parameters of the model's effects for each world from their fitted 95 % intervals."""

    @property
    def simulation_steps(self) -> int:
        """Simulation steps of one action."""
        return self.decimation // self.stride

    @property
    def seconds(self) -> float:
        """Length of an episode [s]."""
        if self.episode is not None:
            return self.episode
        return CHAINED if self.stage == ALL else SINGLE


@dataclass(frozen=True)
class PpoCfg:
    """PPO as in rsl-rl; networks and action distribution as in the paper, appendix C.

    Example:
        >>> import concent_warp as cw
        >>> cw.PpoCfg(iterations=200, learning_rate=1e-3).iterations
        200
    """

    iterations: int = 300
    """Rounds of collecting and updating."""
    steps: int = 24
    """Steps of each environment in a round."""
    epochs: int = 5
    """Passes over what was collected."""
    batches: int = 4
    """Batches of a pass."""
    hidden: tuple[int, ...] = (256, 256, 256)
    """Sizes of the hidden layers of policy and value function."""
    activation: str = "swish"
    """Activation of both."""
    std: float = 0.6
    """Standard deviation of the Gaussian before squashing, at the start."""
    normalise: bool = True
    """Normalise observations by their running mean and deviation."""
    discount: float = 0.98
    """Discount factor of a step."""
    lam: float = 0.95
    """Weight of longer returns in the advantage."""
    clip: float = 0.2
    """Clipping of the probability ratio."""
    entropy: float = 0.002
    """Weight of the entropy."""
    value: float = 1.0
    """Weight of the value loss."""
    learning_rate: float = 1e-3
    """Learning rate at the start."""
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """Whether the learning rate follows the divergence between updates."""
    divergence: float = 0.01
    """Divergence that the adaptive rate aims at."""
    gradient: float = 1.0
    """Largest norm of the gradient."""
    tf32: bool = True
    """Multiply matrices with 10 bits of mantissa on a GPU, which is quicker."""


@dataclass(frozen=True)
class TrainCfg:
    """A whole training.

    Example:
        >>> import concent_warp as cw
        >>> cfg = cw.TrainCfg(environment=cw.EnvironmentCfg(stage="insert"), ppo=cw.PpoCfg(iterations=100))
        >>> cfg.environment.stage
        'insert'
    """

    seed: int = 0
    """Seed of everything drawn at random."""
    checkpoint: int = 50
    """Rounds between checkpoints; one is also written at the end and when interrupted."""
    target: float | None = None
    """Share of successful episodes in a round at which training stops early."""
    environment: EnvironmentCfg = field(default_factory=EnvironmentCfg)
    ppo: PpoCfg = field(default_factory=PpoCfg)

    def __post_init__(self) -> None:
        e, p = self.environment, self.ppo
        for name, value in {
            "worlds": e.worlds,
            "decimation": e.decimation,
            "stride": e.stride,
            "slots": e.observation.slots,
            "states": e.reset.states,
            "iterations": p.iterations,
            "steps": p.steps,
            "checkpoint": self.checkpoint,
        }.items():
            if value < 1:
                raise TrainError(f"{name} is not right", expected="at least 1", found=value)
        if e.decimation % e.stride:
            raise TrainError(
                "an action is no whole number of simulation steps",
                expected=f"a divisor of the decimation, {e.decimation}",
                found=f"stride {e.stride}",
            )
        push = e.randomisation
        if min(push.push) < 0 or not 0 <= push.push_share <= 1:
            raise TrainError(
                "pushes are not right",
                expected="deviations of at least 0 and a share from 0 to 1",
                found=f"push {push.push}, push_share {push.push_share}",
            )
        if e.worlds * p.steps < p.batches:
            raise TrainError(
                "a round holds fewer steps than batches", expected=f"at least {p.batches}", found=e.worlds * p.steps
            )

    def save(self, path: Path) -> None:
        """Write a TOML file, in one piece or not at all; what is None is left out."""
        import tomli_w

        write_text(path, tomli_w.dumps(plain(self)))

    @staticmethod
    def load(path: Path) -> TrainCfg:
        """Read what `save` wrote.

        Raises:
            TrainError: The file is missing or is no such configuration.
        """
        if not path.is_file():
            raise TrainError("no such configuration of a training", where=path)
        try:
            return decode(TrainCfg, tomllib.loads(path.read_text()), str(path))
        except tomllib.TOMLDecodeError as error:
            raise TrainError("not a TOML file", where=path, found=error) from None
        except ConcentError as error:
            raise TrainError(str(error)) from None


def plain(value: Any) -> Any:
    """Return nested dataclasses as TOML holds them."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items() if item is not None}
    return list(value) if isinstance(value, tuple) else value
