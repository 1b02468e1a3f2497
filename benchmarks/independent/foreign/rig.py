"""What an experiment of a world on another engine consists of: nominal scene, motions, sensors, true physics.

The nominal scene is MJCF text with named values. The world's values are drawn about them: masses and gains within
`TOLERANCE`, lengths within `TOLERANCE` and `MACHINING`. Nothing here imports an engine.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import mujoco
import numpy as np

from benchmarks.independent.data_set import TOLERANCE
from concent_warp.scene.scene import Scene

MACHINING = 3e-4
"""Largest error of a length [m]: ISO 2768-1, class m, for lengths from 30 to 120 mm."""
GRAVITY = 9.81
"""Gravity [m/s^2]."""
Reading = Literal["angle", "fine_angle", "travel", "marker", "position", "orientation"]
ENCODERS: tuple[Reading, ...] = ("angle", "fine_angle", "travel")
Action = Mapping[str, tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Sensor:
    """A sensor of the nominal scene, and what it sees of the world."""

    name: str
    kind: Reading
    target: str
    """Joint of an encoder; body that carries a marker or is tracked."""
    offset: Callable[[Mapping[str, float]], tuple[float, float, float]] = lambda _: (0.0, 0.0, 0.0)
    """Place of a marker on its body [m], given the world's values."""


@dataclass(frozen=True)
class Drive:
    """A position-controlled drive. Gains, friction and inertia are values of its rig, by their names."""

    actuator: str
    joint: str
    kp: str
    kv: str
    armature: str
    weight: float = 1.0
    """Share of a hidden effect's magnitude that this drive gets, where drives differ in size."""


@dataclass(frozen=True)
class ForeignTrial:
    """One motion."""

    duration: float
    """Duration [s]."""
    action: Action = field(default_factory=dict)
    """Commands by actuator: times [s] and values, shapes (T,); each holds until the next."""
    pose: Sequence[float] = ()
    """Pose of the free body when the simulation begins, x y z and quaternion wxyz, shape (7,)."""
    velocity: Sequence[float] = ()
    """Its velocity then, linear [m/s] and angular [rad/s], both in the world frame, shape (6,)."""
    before: float = 0.02
    """Simulated time before time 0 [s]; the first command acts."""


@dataclass(frozen=True)
class ForeignRig:
    """An experiment."""

    name: str
    text: str
    """Nominal MJCF with values in braces."""
    values: Mapping[str, float]
    """Nominal values."""
    masses: tuple[str, ...]
    """Values that are masses, inertias or gains, wrong by up to `TOLERANCE`; those joined by "+" by the same factor."""
    lengths: tuple[str, ...]
    """Values that are lengths."""
    sensors: tuple[Sensor, ...]
    plan: Callable[[np.random.Generator], ForeignTrial]
    """Samples a motion."""
    step: float
    """Time step of the discrete world [s]; of a continuous one, the time over which external forces are held."""
    continuous: bool = False
    """Whether the world is integrated with error control; without contacts only."""
    drives: tuple[Drive, ...] = ()
    links: tuple[str, ...] = ()
    """Bodies moved by drives, from the base on."""
    friction: Mapping[str, str] = field(default_factory=dict)
    """Coulomb friction of joints: the name of the value."""
    damping: Mapping[str, str] = field(default_factory=dict)
    """Viscous damping of joints: the name of the value."""
    body: str = ""
    """The free body, or the last link."""
    shape: Literal["none", "box", "ball"] = "none"
    """Shape of the free body that touches the table, of sizes `half_x`, `half_y`, `half_z` or `radius`."""
    finger: str = ""
    """Body with a vertical cylinder, of `finger_radius` and `finger_length`, that pushes the box."""
    bounces: bool = False
    """Whether contacts are given by `stiffness` [N/m] and `damping_ratio` [-]."""
    throws: int = 1
    """Motions of a demonstration."""
    start_recorded: bool = False
    """Whether the recording has an estimate of the initial state."""
    engine: Literal["Drake", "Bullet"] = field(kw_only=True)
    """What simulates the world."""

    @cached_property
    def scene(self) -> Scene:
        """The user's nominal scene."""
        return Scene.from_spec(
            mujoco.MjSpec.from_string(self.text.format(**self.values)), source=f"{self.name}, {self.engine}"
        )

    @property
    def free(self) -> bool:
        """Whether the body under test has a free joint."""
        return int(mujoco.mjtJoint.mjJNT_FREE) in self.scene.model.jnt_type

    @property
    def hinges(self) -> bool:
        """Whether driven joints are hinges."""
        m = self.scene.model
        return any(m.jnt_type[m.joint(d.joint).id] == mujoco.mjtJoint.mjJNT_HINGE for d in self.drives)

    def drawn(self, seed: int) -> dict[str, float]:
        """Return the world's values, drawn about the nominal ones by a seed."""
        rng = np.random.default_rng([seed, *self.name.encode()])
        true = dict(self.values)
        for names in self.masses:
            factor = 1 + rng.uniform(-TOLERANCE, TOLERANCE)
            true |= {name: true[name] * factor for name in names.split("+")}
        for name in self.lengths:
            most = min(TOLERANCE, MACHINING / abs(true[name]))
            true[name] *= 1 + rng.uniform(-most, most)
        return true


@dataclass
class DriveState:
    """What a drive of the world does."""

    gain: float = 1.0
    """Factor on its torque [-]."""
    delay: float = 0.0
    """Age of commands that act [s]."""
    lag: float = 0.0
    """Time constant of the filter of its commands [s]."""
    limit: float = np.inf
    """Largest torque or force [N m or N]."""
    offset: float = 0.0
    """How far the true position is beyond what its encoder reads [rad or m]."""
    play: float = 0.0
    """Free play between motor and link [rad]; the encoder is on the link."""
    compliance: float = 0.0
    """Compliance of a spring between motor and link [rad/(N m)]; the encoder is on the motor."""
    armature: float = 0.0
    """Rotor inertia times the square of the gear ratio [kg m^2 or kg]."""


@dataclass
class Friction:
    """Friction of a joint of the world, by the model of Canudas de Wit, Olsson, Astrom and Lischinsky (1995)."""

    coulomb: float
    """Friction in motion [N m or N]."""
    extra: float = 0.0
    """By how much friction at rest is larger [N m or N]."""
    speed: float = 0.2
    """Speed at which the additional friction has fallen to a third [rad/s or m/s]."""
    bristle: float = 4e-4
    """Deflection at which sliding begins [rad or m]."""
    scale: Callable[[float], float] = lambda _: 1.0
    """Factor on all of it at a time [s]."""


@dataclass
class BodyState:
    """Position and velocity of the body under test: its centre of mass, in the world frame."""

    center: np.ndarray
    velocity: np.ndarray
    turning: np.ndarray
    """Angular velocity [rad/s], world frame, shape (3,)."""
    rotation: np.ndarray
    """Rotation matrix, body to world, shape (3, 3)."""


BodyForce = Callable[[float, BodyState], tuple[np.ndarray, np.ndarray]]
"""Given time [s] and state, returns force [N] on the centre of mass and torque [N m], world frame, shapes (3,)."""
JointForce = Callable[[float, float, float], float]
"""Given time [s], position and velocity of a joint, returns a torque or force on it [N m or N]."""
Measure = Callable[[str, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Given a sensor's name, time stamps [s] (T,) and values (T, dim), returns what is written down."""


@dataclass
class Physics:
    """The world: what is true of a rig, with all that is hidden."""

    values: dict[str, float]
    drives: dict[str, DriveState]
    """By actuator."""
    friction: dict[str, Friction]
    """By joint."""
    damping: dict[str, float]
    """Viscous damping by joint [N m s/rad or N s/m]."""
    gravity: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, -GRAVITY]))
    compensation: float = 0.0
    """Share of the links' weight that drives compensate beyond their position control [-]."""
    mass: float = 1.0
    """Factor on mass and inertia of the body under test [-]."""
    inertia: float = 1.0
    """Factor on its inertia [-]."""
    center: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Shift of its centre of mass [m], body frame."""
    size: float = 1.0
    """Factor on its size where it touches the table [-]; mass and inertia stay."""
    slosh: float = 0.0
    """Share of the body's mass that swings in it on springs [-]; on Drake only."""
    body_forces: list[BodyForce] = field(default_factory=list)
    joint_forces: dict[str, list[JointForce]] = field(default_factory=dict)
    measures: list[Measure] = field(default_factory=list)
    sensor_delay: float = 0.0
    """Age of what trackers, or encoders where there is no tracker, see beyond the instruments' own [s]."""


def true_physics(rig: ForeignRig, seed: int) -> Physics:
    """Return the world of a rig in which nothing is hidden."""
    values = rig.drawn(seed)
    return Physics(
        values,
        {d.actuator: DriveState(armature=values[d.armature]) for d in rig.drives},
        {joint: Friction(values[name]) for joint, name in rig.friction.items()},
        {joint: values[name] for joint, name in rig.damping.items()},
    )


@dataclass(frozen=True)
class ForeignMotion:
    """The true motion on a grid of times."""

    time: np.ndarray
    """Times [s], shape (K,), from before 0 on."""
    joints: dict[str, np.ndarray]
    """Positions of joints [rad or m], shapes (K,)."""
    motors: dict[str, np.ndarray]
    """Positions on the motor's side of gears, by joint, shapes (K,); the joint's where there is no gear."""
    poses: dict[str, np.ndarray]
    """Poses of bodies that sensors see, x y z and quaternion wxyz, shapes (K, 7)."""


Simulate = Callable[[ForeignRig, Physics, ForeignTrial], ForeignMotion]
"""What an engine does: return the true motion of a trial."""
