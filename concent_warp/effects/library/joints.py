"""Effects in joints: friction of four kinds, springs, rotor inertia, zero offset."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from concent_warp.effects.effect import Effect, Parameter
from concent_warp.effects.library.friction_forces import LoadFriction, StribeckFriction
from concent_warp.effects.select import (
    BEARINGS,
    SINGLE,
    dof_of,
    dofs_of,
    joints_by_type,
    servo_stiffness,
    typical_torque,
)
from concent_warp.scene.holding import FRICTION_IMPEDANCE, TIME_CONSTANT_STEPS

if TYPE_CHECKING:
    from concent_warp.effects.force_model import ForceModel

FRICTION_SCATTER = 0.03
"""Relative standard deviation of friction between repeated measurements [-]: several per cent, as it varies with place,
time and temperature (joints: Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30(7), 1994; Bittencourt and
Gunnarsson, J. Dyn. Sys. Meas. Control 134(5), 2012; contacts: Yu, Bauza, Fazeli and Rodriguez, IROS 2016)."""
MUJOCO = "MuJoCo documentation, chapters Computation and Modeling"
FARTHEST_REST = 1e4
"""Farthest rest position of a spring [rad or m]: from there its force is the same in all positions, to a single
precision of the force."""


USUAL_SHARE = 0.3
"""Typical difference of a value from the model's, relative to it [-]."""
LONGEST_LAG = 0.5
"""Longest time by which damping makes a joint follow its position-controlled drive later [s], as that of a lag of the
drive itself."""


class JointEffect(Effect):
    """An effect with one parameter for each joint."""

    family = "joints"
    kind = "joint"
    requirement = "hinges and slides"
    joint_types: ClassVar[tuple[int, ...]] = SINGLE
    """Types of the joints that it acts on."""

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:
        """Return whether the joint is of such a type."""
        return int(m.jnt_type[i]) in self.joint_types

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return all hinges, all slides, and for some effects all ball joints."""
        return joints_by_type(m, kinds=cls.joint_types)

    def units(self, m: mujoco.MjModel, hinge: str, slide: str) -> str:
        """Return the unit on the target's joints."""
        kinds = m.jnt_type[self.ids(m)]
        return slide if (kinds == int(mujoco.mjtJoint.mjJNT_SLIDE)).all() else hinge

    def parameter_per_joint(
        self, name: str, unit: str, null: np.ndarray, scale: np.ndarray, high: np.ndarray, typical: float = 0.0
    ) -> tuple[Parameter, ...]:
        """Return one parameter a joint, from 0 up; `typical` is in units of the scale.

        What the model has already is off by a share of it.
        """
        scale = np.maximum(scale, USUAL_SHARE * null)
        rows = zip(self.target, null, high, scale, strict=True)
        return tuple(
            Parameter(f"{name}[{t}]", unit, float(n), 0.0, float(h), float(s), typical=typical * float(s))
            for t, n, h, s in rows
        )


class BearingEffect(JointEffect):
    """An effect in the bearings of hinges, slides and ball joints, alike about each axis of a ball joint."""

    requirement = "hinges, slides and ball joints"
    joint_types = BEARINGS

    def set_dofs(self, field: np.ndarray, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set values of the degrees of freedom, shape (nv,), of each joint to that of the joint, not below 0."""
        dofs, rows = dofs_of(m, self.ids(m))
        field[dofs] = np.maximum(values, 0.0)[rows]


class DryFriction(JointEffect):
    """Friction that holds the joint at rest."""

    variables = ("joint velocity",)
    formula_error = FRICTION_SCATTER

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Let it hold stiffly, where the joint has no friction of its own yet."""
        for n in self.target:
            let_friction_hold(spec.joint(n), spec.option.timestep)


def let_friction_hold(element: mujoco.MjsJoint | mujoco.MjsTendon, timestep: float) -> None:
    """Let the friction of a joint or tendon hold stiffly at a time step [s], where it has none of its own yet."""
    if not element.frictionloss:
        element.solref_friction = [TIME_CONSTANT_STEPS * timestep, 1.0]
        element.solimp_friction[:2] = FRICTION_IMPEDANCE


class JointFriction(DryFriction, BearingEffect):
    """Dry friction in joints."""

    name = "joint_friction"
    summary = "A torque of constant size against the motion, which holds the joint at rest: |tau| <= F."
    source = f"Coulomb friction; MuJoCo's friction loss ({MUJOCO})"
    signature = "residual torque like -sign(velocity), whatever the speed; jumps at reversals, sticks in slow motion"
    confusions = ("joint_damping", "stribeck_friction", "load_friction")

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one torque for each joint."""
        ids = self.ids(m)
        scale = typical_torque(m, ids)
        null = m.dof_frictionloss[dof_of(m, ids)]
        return self.parameter_per_joint(
            "torque", self.units(m, "N m", "N"), null, 0.3 * scale, np.maximum(20 * scale, 5 * null)
        )

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Friction loss."""
        return ("dof_frictionloss",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set the friction loss."""
        self.set_dofs(m.dof_frictionloss, m, values)


class JointDamping(BearingEffect):
    """Viscous friction in joints."""

    name = "joint_damping"
    summary = "A torque against the motion in proportion to the speed: tau = -d qd."
    source = f"viscous friction; MuJoCo's joint damping ({MUJOCO})"
    signature = "residual torque in proportion to velocity"
    confusions = ("joint_friction", "actuator_gain", "air_drag")
    variables = ("joint velocity",)
    formula_error = FRICTION_SCATTER

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one coefficient for each joint."""
        ids = self.ids(m)
        scale, null = typical_torque(m, ids), m.dof_damping[dof_of(m, ids)]
        unit = self.units(m, "N m s/rad", "N s/m")
        most = np.maximum.reduce([20 * scale, 5 * null, LONGEST_LAG * servo_stiffness(m, ids)])
        return self.parameter_per_joint("damping", unit, null, 0.3 * scale, most)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Damping."""
        return ("dof_damping",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set the damping."""
        self.set_dofs(m.dof_damping, m, values)


class JointStiffness(JointEffect):
    """Springs in joints.

    The force is linear in both parameters. In stiffness and rest position it is not: without stiffness no rest position
    would show, and a spring that rests far outside the motion, as one that closes a door, would hardly show in its
    stiffness alone.
    """

    name = "joint_stiffness"
    summary = "A spring on the joint: tau = preload - stiffness q, which rests at q = preload / stiffness."
    source = f"Hooke's law; MuJoCo's joint stiffness and springref ({MUJOCO})"
    signature = "residual torque that is linear in position, whatever the speed and the command"
    confusions = ("gravity_compensation", "actuator_gain", "mass", "gravity_tilt", "joint_offset", "center_of_mass")

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return stiffness, then preload of each joint: the force of its spring where the joint reads zero.

        A typical spring swings the joint at half a hertz, and moves it at 10 rad/s^2 where it is preloaded.
        """
        ids = self.ids(m)
        typical, stiffness, preload = typical_torque(m, ids), m.jnt_stiffness[ids], _preload(m, ids)
        stiffnesses = self.parameter_per_joint(
            "stiffness",
            self.units(m, "N m/rad", "N/m"),
            stiffness,
            0.3 * typical,
            np.maximum(200 * typical, 5 * stiffness),
            1 / 0.3,
        )
        unit, farthest = self.units(m, "N m", "N"), np.maximum(200 * typical, 5 * np.abs(preload))
        typical = np.maximum(typical, np.abs(preload))
        preloads = (
            Parameter(
                f"preload[{n}]", unit, float(p), -float(far), float(far), USUAL_SHARE * float(t), typical=float(t)
            )
            for n, p, far, t in zip(self.target, preload, farthest, typical, strict=True)
        )
        return (*stiffnesses, *preloads)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Stiffness and rest position."""
        return ("jnt_stiffness", "qpos_spring")

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set both; a preload without stiffness is that of a weak spring that rests far away."""
        ids = self.ids(m)
        stiffness, preload = np.split(np.asarray(values, dtype=float), 2)
        stiffness = np.maximum(np.maximum(stiffness, 0.0), np.abs(preload) / FARTHEST_REST)
        changed = (stiffness != m.jnt_stiffness[ids]) | (preload != _preload(m, ids))
        rest = np.divide(preload, stiffness, out=np.zeros_like(preload), where=stiffness > 0)
        m.qpos_spring[m.jnt_qposadr[ids[changed]]] = rest[changed]
        m.jnt_stiffness[ids] = stiffness


def _preload(m: mujoco.MjModel, joints: np.ndarray) -> np.ndarray:
    """Return the force of the spring of each hinge or slide where the joint reads zero [N m or N], shape (n,)."""
    return m.jnt_stiffness[joints] * m.qpos_spring[m.jnt_qposadr[joints]]


class Armature(JointEffect):
    """Inertia of rotors behind gears."""

    name = "armature"
    summary = "Rotor inertia times the square of the gear ratio, added to the joint's own inertia."
    source = f"MuJoCo's armature ({MUJOCO})"
    signature = "residual torque in proportion to acceleration"
    confusions = ("mass", "inertia", "actuator_lag")

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one inertia for each joint; behind a gear it is typically that of the link (inertia matching)."""
        ids = self.ids(m)
        inertia, null = m.dof_M0[dof_of(m, ids)], m.dof_armature[dof_of(m, ids)]
        return self.parameter_per_joint(
            "inertia", self.units(m, "kg m^2", "kg"), null, 0.3 * inertia, null + 10 * inertia, 1 / 0.3
        )

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Armature."""
        return ("dof_armature",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set the armature."""
        m.dof_armature[dof_of(m, self.ids(m))] = np.maximum(values, 0.0)


class JointOffset(JointEffect):
    """Zero of encoder and drive that differs from the nominal model's."""

    name = "joint_offset"
    summary = "Encoder and drive count from a zero that is off the nominal model's by an angle."
    source = "kinematic calibration: Hollerbach, Khalil, Gautier, in Springer Handbook of Robotics, 2016"
    signature = "gravity load of the wrong phase; constant pose error of what the robot carries, none in its encoders"
    confusions = ("sensor_bias", "gravity_tilt", "frame_offset")

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one offset for each joint: how far the true angle is beyond the reading."""
        slide = self.units(m, "rad", "m") == "m"
        high, scale = (0.05, 0.003) if slide else (0.5, 0.03)
        return self.parameter_per_target("offset", "m" if slide else "rad", 0.0, low=-high, high=high, scale=scale)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Joint reference position and rest position of its spring."""
        return ("qpos0", "qpos_spring")

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Shift both."""
        address = m.jnt_qposadr[self.ids(m)]
        m.qpos0[address] -= values
        m.qpos_spring[address] -= values


class Stribeck(DryFriction):
    """More friction at rest than in motion."""

    name = "stribeck_friction"
    summary = "Friction beyond the joint's own that fades with speed: extra exp(-(qd / speed)^2)."
    source = "Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30(7), 1994"
    signature = "stick-slip and overshoot out of rest; residual torque near zero speed only"
    confusions = ("joint_friction", "backlash")
    special_cases = ("joint_friction",)

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one torque for each joint, and the speed at which it has fallen to a third."""
        ids = self.ids(m)
        torque, zero = typical_torque(m, ids), np.zeros(len(ids))
        parameters = self.parameter_per_joint("extra", self.units(m, "N m", "N"), zero, 0.3 * torque, 20 * torque)
        slide = self.units(m, "rad", "m") == "m"
        speed = Parameter(
            "speed", "m/s" if slide else "rad/s", 0.02 if slide else 0.2, 1e-3, 5.0, 0.02 if slide else 0.2
        )
        return (*parameters, speed)

    def force_model(self, m: mujoco.MjModel) -> ForceModel:
        """Friction loss that depends on speed."""
        return StribeckFriction(dof_of(m, self.ids(m)))


class LoadDependentFriction(DryFriction):
    """Friction that grows with the torque which the gears carry."""

    name = "load_friction"
    summary = (
        "Friction beyond the joint's own in proportion to the load between motor and link: c (|tau_m| + |tau_e|) / 2."
    )
    source = "Duclusaud, Passault, Padois, Daney: Extended friction models for the simulation of servo actuators, 2024"
    signature = "residual torque like -sign(velocity) |load|"
    confusions = ("joint_friction", "actuator_gain")

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one coefficient for each joint, up to where a motor exerts 7 times the load that it drives."""
        return self.parameter_per_target("coefficient", "-", 0.0, low=0.0, high=1.5, scale=0.1)

    def force_model(self, m: mujoco.MjModel) -> ForceModel:
        """Friction loss that depends on load."""
        return LoadFriction(dof_of(m, self.ids(m)))
