"""Settings of a training: a tree of plain data, on the command line and in every run folder."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from concent_warp.checks import (
    Bounds,
    Count,
    Duration,
    Interval,
    Positive,
    PositiveDuration,
    PositiveInterval,
    Share,
    Signed,
    Worlds,
)
from concent_warp.documents import read_toml
from concent_warp.errors import ConcentError, TrainError
from concent_warp.events.decode import decode
from concent_warp.files import write_text
from concent_warp.run_folder import TRAIN_SETTINGS, plain
from concent_warp.train.check_cfg import check_cfg
from concent_warp.train.observation_cfg import ObservationCfg, SensorErrorsCfg
from concent_warp.train.reset_cfg import ResetCfg

Range = tuple[float, float]
ALL = "all"
"""Name of the chain of all stages."""
LAST = "last"
"""Name of the last stage, whatever it is called."""
SINGLE_STAGE_DURATION, CHAIN_DURATION = 3.0, 12.0
"""Default durations of an episode of one stage and of a chain of stages [s]."""
SETTINGS = TRAIN_SETTINGS
"""File of the resolved configuration in a run folder."""


@dataclass(frozen=True)
class ActionCfg:
    """Mapping from an action to commands: each number in -1..1 is a share of the largest step."""

    turn: Positive = 0.006
    """Largest step of a hinge joint's command [rad]."""
    slide: Positive = 0.004
    """Largest step of a slide joint's command [m]."""
    gripper: Positive = 0.003
    """Largest step of the gripper's command [m]: so small that exploration does not drop a grasped object at once."""
    gripper_share: Share = 0.075
    """The same of a gripper whose command is no length, such as suction, turning fingers or 0 to 255: a share of its
    ctrlrange."""
    turn_lead: Positive = 0.03
    """Largest difference of command and position of a hinge joint [rad]; times the stiffness it bounds the torque."""
    slide_lead: Positive = 0.015
    """Largest difference of command and position of a slide joint [m]; times the stiffness it bounds the force."""
    gripper_actuators: tuple[str, ...] = ("gripper",)
    """Actuators that open and close the gripper, or switch suction, with one number; a scene without the default has no
    gripper."""
    tool_site: str = "tcp"
    """Site between the fingertips: the end-effector."""


@dataclass(frozen=True)
class EngineeredCfg:
    """The engineered insertion reward, a baseline (paper, appendix G)."""

    hole: tuple[Signed, Signed, Signed] = (0.0, 0.0, 0.0)
    """Centre of the hole in the frame of object 2 [m]."""
    seat: Signed = 0.0235
    """Height of object 1 above object 2's origin at which it is fully seated [m]."""
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
    """The contact-event reward, or the engineered reward as a baseline."""
    reach: float = 1.0
    """Weight of the reaching term [-]."""
    regularisation: float = 1.0
    """Weight of the regularisation [-]."""
    vcp: float = 1.0
    """Weight of the virtual collision penalty [-]."""
    far: Range = (1.0, 0.05)
    """Amplitude and length scale [m] of the far reaching term."""
    near: Range = (2.0, 0.008)
    """Amplitude and length scale [m] of the near reaching term."""
    wide: Range = (1.0, 0.3)
    """Amplitude and length scale [m] of a third reaching term in chains of stages, for the approach to an object."""
    completion: float = 500.0
    """In chains, reward of each completed stage, once in an episode, of the last one when object 1 has come to rest in
    place, which ends the episode: more than twice what the reaching terms bring within the horizon of the discount, so
    that trying the next stage pays off even where it fails as often as it succeeds."""
    stage: float = 0.0
    """In chains, reward per step for each completed stage. An object dropped in a later stage then costs as much as all
    stages before were worth, so that policies learn not to try."""
    action: float = 0.01
    """Penalty of the squared action [-]."""
    velocity: float = 0.001
    """Penalty of the squared arm joint velocity [s^2/rad^2]."""
    press: float = 0.0
    """Penalty of the squared difference of command and joint position relative to the largest allowed, which limits
    force and speed."""
    disturb_position: float = 2.0
    """Penalty of an object's displacement between steps [1/m]: in the hand where the stage grasps it, else in the
    world."""
    disturb_rotation: float = 1.0
    """Penalty of an object's rotation between steps [1/rad], likewise."""
    failure: float = 5.0
    """Penalty of an episode that ends in failure [-]."""
    lenience: float = 0.0
    """Factor on the penalties of virtual collisions and failure while no episode succeeds; it rises to 1 with the
    square of the success rate. Large penalties from the start keep a policy away from its target."""
    scale: float = 0.05
    """Factor on the whole reward, divided by the number of chained stages; the value function learns faster when
    returns are of order 1."""
    engineered: EngineeredCfg = field(default_factory=EngineeredCfg)
    """Settings of the engineered reward."""


@dataclass(frozen=True)
class CollisionCfg:
    """The virtual collision penalty (paper, section 3.2.2)."""

    margin: float = 0.002
    """Distance below which spheres outside the physics are penalised [m]."""
    severe: float = 0.004
    """Penetration of such a sphere that ends the episode [m]."""
    slack: float = 0.0005
    """Reduction of the radii of these spheres [m]: the penetration that contacts of the physics have as well."""
    depth: float = 1000.0
    """Penalty of a penetration [1/m], summed over the spheres. If it is too small, the policy learns to pass through
    what the physics leaves out."""
    band: float = 0.01
    """Penalty of a sphere in touch, falling to 0 at the margin."""
    points: Annotated[int, Bounds(0, 1_000_000)] = 512
    """Surface points of each object that must stay outside the other objects too: spheres round off edges, and a policy
    trained with these points also succeeds where edges are sharp."""
    candidates: Annotated[int, Bounds(1, 10_000_000)] = 20_000
    """Random surface points of which farthest point sampling selects `points`."""
    threads: Annotated[int, Bounds(1, 1024)] = 128
    """GPU threads per world."""


@dataclass(frozen=True)
class ChainCfg:
    """When a world moves to the next stage, and when its episode ends."""

    tolerance: Positive = 0.004
    """Largest distance of all contact pairs at which a target event is met [m]."""
    hold: Count = 2
    """Consecutive control steps for which they must be within it."""
    rest: Duration = 0.5
    """Time for which object 1 must be in place before an episode of a chain ends [s]."""


@dataclass(frozen=True)
class RandomisationCfg:
    """Domain randomisation; values are sampled once for each world."""

    friction: PositiveInterval = (0.5, 2.0)
    """Factor on the sliding friction of all geoms except the robot's."""
    grip: PositiveInterval = (0.8, 1.25)
    """Factor on the sliding friction of the robot's geoms; a grasp has the larger friction of object and finger."""
    stiffness: PositiveInterval = (0.9, 1.1)
    """Factor on the stiffness of the position control."""
    damping: PositiveInterval = (1.0, 1.0)
    """Factor on the damping of the joints."""
    mass: PositiveInterval = (0.9, 1.1)
    """Factor on mass and inertia of the objects."""
    joint_friction: Interval = (0.0, 0.0)
    """Dry friction of the joint with the strongest drive [N m or N]; of others in proportion to their torque limits."""
    delay: Interval = (0.0, 0.0)
    """Delay of the arm's commands [s]."""
    lag: Interval = (0.0, 0.0)
    """Time constant of a first-order lag of the arm's set points [s]."""
    perturbation: tuple[float, float] = (3.0, 0.08)
    """Random force perturbations: standard deviations of a force [N] and a torque [N m] per axis that act on object 1
    for one action while the stage grasps it; none in evaluations."""
    perturbation_share: Share = 0.2
    """Share of actions with random force perturbations."""
    extremes: bool = False
    """Whether a value is one of the ends of its range, in place of any value within it."""


@dataclass(frozen=True)
class EdgeCfg:
    """Small spheres along the edges of the objects, which the spheres of a contact geometry round off.

    They are added to the physics near the spheres of the contact events, at the nominal edges moved as the fit moved
    the spheres beside them.
    """

    count: Annotated[int, Bounds(0, 100_000)] = 400
    """Spheres along all edges of all objects, of which those near touched spheres are taken; 0 for none."""
    radius: Positive = 0.0015
    """Their radius [m]."""
    reach: Positive = 0.01
    """Largest distance of their centres from that of a touched sphere [m]."""
    gap: Positive = 0.003
    """Smallest distance from a small sphere that the contact geometry has there already [m]."""


@dataclass(frozen=True)
class EnvironmentCfg:
    """The vectorised environment.

    Example:
        >>> import concent_warp as cw
        >>> cw.EnvironmentCfg(stage="insert", worlds=4096).worlds
        4096
    """

    stage: str = LAST
    """Stage of the contact event sequence whose target event is trained; "last" is the last one, "all" chains all."""
    worlds: Worlds = 4096
    """Number of environments simulated in parallel, on each rank."""
    episode: PositiveDuration | None = None
    """Duration of an episode [s]; by default 3 s for one stage and 12 s for a chain."""
    success: Positive = 0.003
    """Largest deviation per axis of object 1 from its demonstrated position in object 2 that counts as success [m]."""
    collision: Literal["vcp", "full"] = "vcp"
    """Spheres in the physics: "vcp" those of the contact event sequence, with the virtual collision penalty on the
    others; "full" all."""
    engine: Literal["auto", "warp", "mujoco"] = "auto"
    """MuJoCo-Warp or C MuJoCo; "auto" takes MuJoCo-Warp on a GPU and C MuJoCo on a CPU."""
    decimation: Annotated[int, Bounds(1, 100_000)] = 10
    """Time steps of the model per action."""
    stride: Annotated[int, Bounds(1, 100_000)] | None = None
    """Time steps of the model per simulation step: coarser physics in less time. By default as many as leave a
    simulation step at half the time constant of the stiffest contact, which contacts need at least."""
    cone: Literal["auto", "elliptic", "pyramidal"] = "auto"
    """Friction cones; "auto" keeps the model's. Pyramidal cones are faster; their friction is weaker between the axes
    than along them, and grasped objects slip more."""
    dropped: Positive = 0.02
    """Distance of a contact pair with the robot at which a grasped object counts as dropped [m]."""
    lost: Positive = 1.0
    """Distance between objects 1 and 2 at which an episode fails [m]."""
    max_position: Positive = 1e4
    """Generalised position above which a world counts as diverged [rad or m]."""
    max_velocity: Positive = 1e4
    """Generalised velocity above which a world counts as diverged [rad/s or m/s]."""
    randomise_effects: bool = True
    """Sample the parameters of the model's effects for each world from their fitted 95 % intervals."""
    nconmax: Count | None = None
    """Contact capacity per world; by default measured on the demonstration."""
    njmax: Count | None = None
    """Constraint capacity per world; by default measured on the demonstration."""
    buffer_factor: Positive = 2.0
    """Default capacities relative to the largest number in the demonstration: exploration makes more contacts."""
    buffer_spare: int = 16
    """Contacts added to the default capacity; four times as many constraints."""
    solver_iterations: Count | None = None
    """Largest number of solver iterations per simulation step; by default the model's."""
    ls_iterations: Count | None = None
    """Largest number of line-search iterations; by default the model's."""
    jacobian: Literal["auto", "dense", "sparse"] = "auto"
    """Storage of the constraint Jacobian: same results, different speed; "auto" decides as MuJoCo does."""
    capture: Literal["none", "physics", "step"] = "step"
    """What is captured in CUDA graphs: nothing, the physics, or the whole step."""
    fuse: bool = False
    """Compile the torch operations of a captured step into few kernels: faster steps, longer start."""
    action: ActionCfg = field(default_factory=ActionCfg)
    """Actions."""
    observation: ObservationCfg = field(default_factory=ObservationCfg)
    """Observations."""
    reward: RewardCfg = field(default_factory=RewardCfg)
    """Reward."""
    virtual: CollisionCfg = field(default_factory=CollisionCfg)
    """Virtual collisions."""
    edges: EdgeCfg = field(default_factory=EdgeCfg)
    """Small spheres along edges."""
    reset: ResetCfg = field(default_factory=ResetCfg)
    """Reset states."""
    chain: ChainCfg = field(default_factory=ChainCfg)
    """Stages in turn."""
    randomisation: RandomisationCfg = field(default_factory=RandomisationCfg)
    """Domain randomisation."""

    @property
    def seconds(self) -> float:
        """Duration of an episode [s]."""
        if self.episode is not None:
            return self.episode
        return CHAIN_DURATION if self.stage == ALL else SINGLE_STAGE_DURATION


@dataclass(frozen=True)
class PpoCfg:
    """PPO as in rsl-rl; networks and action distribution as in the paper, appendix C.

    Example:
        >>> import concent_warp as cw
        >>> cw.PpoCfg(iterations=200, learning_rate=1e-3).iterations
        200
    """

    iterations: Count = 100
    """Iterations of collecting steps and updating the policy."""
    learning_rate: Annotated[float, Bounds(0, 1, above_low=True)] = 1e-3
    """Initial learning rate [-]."""
    steps: Annotated[int, Bounds(1, 100_000)] = 24
    """Steps of each environment per iteration."""
    entropy: float = 0.002
    """Weight of the entropy [-]."""
    discount: Share = 0.98
    """Discount factor of a step [-]."""
    epochs: Annotated[int, Bounds(1, 10_000)] = 5
    """Passes over the collected steps per iteration."""
    batches: Annotated[int, Bounds(1, 1_000_000)] = 4
    """Mini-batches per pass."""
    hidden: tuple[Annotated[int, Bounds(1, 100_000)], ...] = (256, 256, 256)
    """Sizes of the hidden layers of policy and value function."""
    activation: Literal[
        "elu", "selu", "relu", "crelu", "lrelu", "tanh", "sigmoid", "softplus", "gelu", "swish", "mish", "identity"
    ] = "swish"
    """Activation function of both networks."""
    std: Positive = 0.6
    """Initial standard deviation of the Gaussian before squashing [-]."""
    max_mean: Positive = 4.0
    """Largest magnitude of the mean before squashing: tanh(4) is 0.9993. Outputs for observations far from those seen
    before can be in the hundreds, where single precision does not represent the change of density by an update."""
    normalise: bool = True
    """Normalise observations by their running mean and standard deviation."""
    max_observation: Positive = 10.0
    """Largest magnitude of a normalised observation [standard deviations]; it bounds networks' outputs and losses."""
    lam: Share = 0.95
    """Lambda of the generalised advantage estimate [-]."""
    clip: Positive = 0.2
    """Clipping of the probability ratio."""
    value: float = 1.0
    """Weight of the value loss [-]."""
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """Whether the learning rate adapts to the Kullback-Leibler divergence of an update."""
    divergence: Positive = 0.01
    """Target Kullback-Leibler divergence of the adaptive learning rate [-]."""
    gradient: Positive = 1.0
    """Largest norm of the gradient [-]."""
    tf32: bool = True
    """Multiply matrices in TF32 (10 bits of mantissa) on a GPU, which is faster."""


@dataclass(frozen=True)
class StressCfg:
    """The stress test: episodes in the model's best physics, with friction and masses at the ends of their ranges.

    Objects have the shapes of the scene, or all spheres with sharp edges; cones are elliptic, contacts stiff and steps
    short.
    """

    shapes: Literal["nominal", "spheres"] = "nominal"
    """Shapes of the objects: those of the scene's geoms, or the spheres. The spheres where the scene has no shapes to
    collide with, such as a mesh with a hole."""

    every: Annotated[int, Bounds(0, 1_000_000)] = 50
    """Iterations between tests during training, of which the best policy is kept; 0 for none. A training that ends
    before the first keeps its last policy."""
    episodes: Count = 256
    """Episodes of a test."""
    time_constant: Positive = 0.004
    """Time constant of contacts [s]; softer ones let a policy slide over edges that catch in Reality."""
    refine: Count = 5
    """Simulation steps per time step of the model; contacts need steps of at most half their time constant."""
    friction: PositiveInterval = (0.6, 1.7)
    """Factors on the sliding friction of the objects, of which a world has one."""
    grip: PositiveInterval = (0.8, 1.25)
    """Factors on the sliding friction of the robot's geoms."""
    stiffness: PositiveInterval = (0.85, 1.15)
    """Factors on the stiffness of the position control."""
    mass: PositiveInterval = (0.85, 1.15)
    """Factors on mass and inertia of the objects."""
    perturbation: tuple[float, float] = (0.0, 0.0)
    """Random force perturbations, as in training: standard deviations of force [N] and torque [N m]."""
    sensors: SensorErrorsCfg = field(default_factory=SensorErrorsCfg)
    """Errors of the instruments."""
    edges: EdgeCfg = field(default_factory=EdgeCfg)
    """Small spheres along edges, where there are spheres."""


@dataclass(frozen=True)
class FinishCfg:
    """The last iterations of a training, in physics with more contacts than those of the demonstration.

    Spheres outside the physics let a policy slide through places where real objects touch and get stuck.
    """

    share: Share = 0.33
    """Share of the iterations; 0 for none."""
    physics: Literal["shapes", "spheres"] = "shapes"
    """What collides: the shapes of the scene's geoms in stiff contacts and short steps, as in the stress test, or all
    spheres of the objects; all spheres, too, where the scene has no shapes to collide with."""


@dataclass(frozen=True)
class TrainCfg:
    """Settings of a training.

    Example:
        >>> import concent_warp as cw
        >>> cfg = cw.TrainCfg(environment=cw.EnvironmentCfg(stage="insert"), ppo=cw.PpoCfg(iterations=100))
        >>> cfg.environment.stage
        'insert'
    """

    seed: int = 0
    """Seed of all random numbers."""
    target: Share | None = None
    """Success rate within an iteration at which training stops early."""
    checkpoint: Count = 50
    """Iterations between checkpoints; one is also written at the end and on interruption."""
    environment: EnvironmentCfg = field(default_factory=EnvironmentCfg)
    """The environment."""
    ppo: PpoCfg = field(default_factory=PpoCfg)
    """Settings of PPO."""
    finish: FinishCfg = field(default_factory=FinishCfg)
    """The last iterations, in physics with more contacts."""
    stress: StressCfg = field(default_factory=StressCfg)
    """The stress test, by which the policy is chosen."""

    def __post_init__(self) -> None:
        check_cfg(self)

    @property
    def finish_from(self) -> int:
        """Iterations before those of `finish`."""
        same = self.finish.physics == "spheres" and self.environment.collision == "full"
        return self.ppo.iterations - (0 if same else round(self.finish.share * self.ppo.iterations))

    @staticmethod
    def for_stage(stage: str) -> TrainCfg:
        """Return the defaults of a training of a stage, as ``concent train --stage`` has them.

        The chain of all stages, "all", has more worlds and reset states, explores more, takes larger steps of the
        joints' commands, since the way to the objects is long, and simulates pyramidal cones, which are faster.

        Example:
            >>> import concent_warp as cw
            >>> cw.TrainCfg.for_stage("all").environment.worlds
            8192
        """
        if stage != ALL:
            return TrainCfg(environment=EnvironmentCfg(stage=stage))
        action, reset = ActionCfg(turn=0.012), ResetCfg(states=4096, free=0.2)
        environment = EnvironmentCfg(stage=ALL, worlds=8192, cone="pyramidal", action=action, reset=reset)
        ppo = PpoCfg(iterations=334, entropy=0.005)
        return TrainCfg(environment=environment, ppo=ppo, finish=FinishCfg(share=0.0))

    def save(self, path: Path) -> None:
        """Write a TOML file atomically; None values are left out."""
        import tomli_w

        write_text(path, tomli_w.dumps(plain(self)))

    @staticmethod
    def load(path: Path) -> TrainCfg:
        """Return the settings that `save` wrote.

        Raises:
            TrainError: The file is missing or not a configuration of a training.
        """
        if not path.is_file():
            raise TrainError("the configuration of a training is missing", where=path)
        try:
            settings = read_toml(path, TrainError)
            if not settings:
                raise TrainError("the configuration of a training is empty", where=path, fix="restore the run folder")
            return decode(TrainCfg, settings, str(path))
        except TrainError:
            raise
        except ConcentError as error:
            raise TrainError(str(error)) from None
