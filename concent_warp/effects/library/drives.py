"""Effects in drives: gain, saturation, delay, lag, play, elasticity, gravity compensation."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from concent_warp.effects.effect import PHASE_ERROR, Effect, Parameter, Reader
from concent_warp.effects.library.elastic_forces import SLOTS, ElasticGearForce
from concent_warp.effects.library.gear_forces import BacklashForce
from concent_warp.effects.library.joints import MUJOCO, JointDamping
from concent_warp.effects.select import (
    SINGLE,
    arm_actuators,
    dof_of,
    driven_joints,
    each_of_several,
    element_name,
    gripper_actuators,
    is_thruster,
    robot_bodies,
    servo_gain,
    thrusters,
)

if TYPE_CHECKING:
    from concent_warp.effects.force_model import ForceModel

TWIST_SENSOR = "concent_twist_{}"
"""Site and sensor that are added for an actuator with an elastic gear: twist, its rate and the servo's force."""
SERVO_FORCE = 2
"""Its last column."""
OF_JOINT = {
    mujoco.mjtSensor.mjSENS_JOINTPOS: 0,
    mujoco.mjtSensor.mjSENS_JOINTVEL: 1,
    mujoco.mjtSensor.mjSENS_JOINTACTFRC: SERVO_FORCE,
}
"""Sensors of a joint that are on the rotor's side of an elastic gear, and the column that changes them."""
OF_ACTUATOR = {
    mujoco.mjtSensor.mjSENS_ACTUATORPOS: 0,
    mujoco.mjtSensor.mjSENS_ACTUATORVEL: 1,
    mujoco.mjtSensor.mjSENS_ACTUATORFRC: SERVO_FORCE,
}
"""Those of an actuator."""

KP, KV = GAINS = ("kp", "kv")
"""The two gains of a position servo, as parts of a drive of which one alone is off."""
PART_RARITY = 4.0
"""Rarity of an error of one of them alone (`Effect.rarity`): a setting is wrong, not the drive's strength."""
GRIP_FACTORS = (0.2, 0.3, *(round(0.36 * 1.1**k, 3) for k in range(11)), 1.5, 3.0)
"""Factors on the grip force that are scanned [-]: the object slips only in a narrow range of them."""


WITH_THRUSTERS = "actuators of joints, of tendons that add joints up, or of sites"


class DriveEffect(Effect):
    """An effect on the actuators of an arm."""

    family = "joints"
    kind = "actuator"
    requirement = "actuators of joints, or of tendons that add joints up"
    of_thrusters: ClassVar[bool] = False
    """Whether actuators that push at a site, as rotors of a drone do, may lack it too."""

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:
        """Return whether the actuator drives a joint, or pushes at a site where that may lack it too."""
        return bool(driven_joints(m, i)) or (self.of_thrusters and is_thruster(m, i))

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return all actuators but the gripper's; where there are none, those that push at sites."""
        found = arm_actuators(m) or (thrusters(m) if cls.of_thrusters else ())
        return (found,) if found else ()


class ServoEffect(DriveEffect):
    """An effect on position-controlled actuators of single joints."""

    requirement = "position-controlled actuators of single hinges and slides, without a filter"

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:
        """Return whether the actuator is position-controlled by its command and drives one joint."""
        joints = driven_joints(m, i)
        single = len(joints) == 1 and int(m.jnt_type[joints[0]]) in SINGLE
        return single and servo_gain(m, i) > 0 and m.actuator_dyntype[i] == int(mujoco.mjtDyn.mjDYN_NONE)

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the position-controlled actuators of single joints."""
        found = tuple(n for n in arm_actuators(m) if cls().applies_to(m, m.actuator(n).id))
        return (found,) if found else ()


class ActuatorGain(DriveEffect):
    """Another gain of an actuator.

    The target is actuators, or position servos with velocity feedback and one of `GAINS`, which alone is off.
    """

    name = "actuator_gain"
    summary = (
        "The drive's force is the model's times a factor, feedback included. Or, by a last target, kp or kv: the"
        " position or the velocity gain alone is, of servos that have both."
    )
    source = f"MuJoCo's actuator gain and bias ({MUJOCO})"
    signature = "residual torque in proportion to the commanded one; more or less sag under load"
    confusions = ("joint_compliance", "gravity_compensation", "load_friction", "mass")
    requirement = f"{WITH_THRUSTERS}; with kp or kv position servos that have both gains"
    of_thrusters = True
    parts = GAINS

    def __init__(self, *target: str) -> None:
        super().__init__(*target)
        if self.part:
            self.rarity = PART_RARITY  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def is_alone(self) -> bool:
        """Whether one gain alone is off, which resembles a gain and damping, or a mass and damping, together."""
        return self.is_part

    def has_as_special_case(self, other: Effect) -> bool:
        """Return whether a damping of joints is what more velocity feedback is."""
        return super().has_as_special_case(other) or (self.part == KV and other.name == JointDamping.name)

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:
        """Return whether it may lack it, and has two gains where one of them is off."""
        return super().applies_to(m, i) and (not self.part or has_both_gains(m, i))

    @classmethod
    def single_targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the actuators that have two gains with each of `GAINS`."""
        both = [tuple(n for n in names if has_both_gains(m, m.actuator(n).id)) for names in cls.targets(m)]
        return tuple((*names, part) for names in both if names for part in cls.parts)

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one factor for each actuator."""
        # More velocity feedback is damping of the joint, and common.
        high = 1.0 if self.part == KV else 5.0
        return self.parameter_per_target(self.part or "gain", "-", 1.0, low=0.05, high=high, scale=0.2)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Gain and bias."""
        return ("actuator_biasprm",) if self.part == KV else ("actuator_gainprm", "actuator_biasprm")

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Scale gain and bias, or what of them belongs to one gain of the servo."""
        ids = self.ids(m)
        if self.part == KV:
            m.actuator_biasprm[ids, 2] *= values
        elif self.part == KP:
            m.actuator_gainprm[ids, 0] *= values
            m.actuator_biasprm[ids, 1] *= values
        else:
            m.actuator_gainprm[ids, :3] *= values[:, None]
            m.actuator_biasprm[ids, :3] *= values[:, None]


def has_both_gains(m: mujoco.MjModel, actuator: int) -> bool:
    """Return whether an actuator is a position servo with velocity feedback."""
    return servo_gain(m, actuator) > 0 and bool(m.actuator_biasprm[actuator, 2])


class GripForce(ActuatorGain):
    """Another gain of the gripper's actuator."""

    name = "grip_force"
    family = "contact"
    summary = (
        "The gripper's force is the model's times a factor. Or, by a last target, kp or kv: the position or the"
        " velocity gain alone is, of a servo that has both."
    )
    source = f"MuJoCo's actuator gain and bias ({MUJOCO})"
    signature = "the grasped object slips or does not; fingers close slower or faster"
    confusions = ("pad_friction", "mass")
    requirement = f"{DriveEffect.requirement}; with kp or kv position servos that have both gains"
    of_thrusters = False

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the actuators of the fingers."""
        found = tuple(n for a in gripper_actuators(m) if (n := element_name(m, mujoco.mjtObj.mjOBJ_ACTUATOR, a)))
        return (found,) if found else ()

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one factor for all."""
        return (Parameter(self.part or "gain", "-", 1.0, 0.02, 10.0, 0.3, scan=GRIP_FACTORS),)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:
        """Gain, bias and limit of the force, which one gain of the servo leaves as it is."""
        return super().fields(m) if self.part else (*super().fields(m), "actuator_forcerange")

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Scale gain, bias and limits."""
        super().write(m, np.broadcast_to(values, (len(self.elements),)))
        if not self.part:
            m.actuator_forcerange[self.ids(m)] *= values


class ActuatorSaturation(DriveEffect):
    """A drive whose force has a lower limit than the model's."""

    name = "actuator_saturation"
    summary = "The drive's force, behind its gear, does not exceed a limit."
    source = f"MuJoCo's force range ({MUJOCO})"
    signature = "residuals only where much torque is commanded: slow start, late arrival"
    confusions = ("actuator_gain", "actuator_lag")
    FREE = 1e6

    @classmethod
    def single_targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return each of several drives: a common value is far off where one drive alone is weak."""
        return each_of_several(cls.targets(m))

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Give each actuator a limit, far away."""
        for n in self.target:
            actuator = spec.actuator(n)
            if not actuator.forcelimited or actuator.forcerange[1] <= actuator.forcerange[0]:
                actuator.forcelimited = True
                actuator.forcerange = [-self.FREE, self.FREE]

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one limit for all actuators of the target, on the joint; its scale is the largest typical torque."""
        joints = np.array([driven_joints(m, a)[0] for a in self.ids(m)])
        top = float(np.max(20 * m.dof_M0[dof_of(m, joints)]))
        scan = tuple((top * np.geomspace(0.05, 20.0, 36)).tolist())  # a limit shows in a narrow range only
        slide = (m.jnt_type[joints] == int(mujoco.mjtJoint.mjJNT_SLIDE)).all()
        return (Parameter("limit", "N" if slide else "N m", np.inf, 0.0, 100 * top, top, scan=scan),)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Limits of the force."""
        return ("actuator_forcerange",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set the limits, those that the model has already kept: MuJoCo's force is that before the gear."""
        ids = self.ids(m)
        limit = np.minimum(float(values[0]) / np.array([lever(m, int(a)) for a in ids]), self.FREE)
        m.actuator_forcerange[ids, 0] = np.maximum(m.actuator_forcerange[ids, 0], -limit)
        m.actuator_forcerange[ids, 1] = np.minimum(m.actuator_forcerange[ids, 1], limit)


def lever(m: mujoco.MjModel, actuator: int) -> float:
    """Return the force on the first joint that an actuator drives over the actuator's own force, without sign.

    It is the gear's ratio, of a fixed tendon times its coefficient there; 1 where the actuator drives no joint.
    """
    joints, gear = driven_joints(m, actuator), abs(float(m.actuator_gear[actuator, 0]))
    if joints and m.actuator_trntype[actuator] == int(mujoco.mjtTrn.mjTRN_TENDON):
        first = m.tendon_adr[m.actuator_trnid[actuator, 0]]
        place = first + m.wrap_objid[first:].tolist().index(joints[0])
        gear *= abs(float(m.wrap_prm[place]))
    return gear if joints and gear > 0 else 1.0


class ActuatorDelay(DriveEffect):
    """Transport delay of commands."""

    name = "actuator_delay"
    summary = "What acts at time t was commanded at t - delay."
    source = "transport delay; linear between time steps"
    signature = "residuals in proportion to the commanded speed; all later by the same time"
    confusions = ("latency", "actuator_lag", "joint_damping")
    requirement = WITH_THRUSTERS
    of_thrusters = True
    step_error = PHASE_ERROR
    singles_last = True
    history = 0.3

    @classmethod
    def single_targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return each of several drives: one alone may be reached by another bus, or a gateway."""
        return each_of_several(cls.targets(m))

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one delay for all."""
        return (Parameter("delay", "s", 0.0, 0.0, self.history, 0.02),)

    def command(self, m: mujoco.MjModel, ctrl: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Shift the commands."""
        delayed, ids = ctrl.copy(), self.ids(m)
        position = np.maximum(np.arange(len(ctrl)) - max(float(values[0]), 0.0) / m.opt.timestep, 0.0)
        lower = np.floor(position).astype(int)
        upper = np.minimum(lower + 1, len(ctrl) - 1)
        weight = (position - lower)[:, None]
        delayed[:, ids] = (1 - weight) * ctrl[lower][:, ids] + weight * ctrl[upper][:, ids]
        return delayed

    def delay_and_lag(self, m: mujoco.MjModel, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the delay of the targets."""
        delay = np.zeros(m.nu)
        delay[self.ids(m)] = max(float(values[0]), 0.0)
        return delay, np.zeros(m.nu)


class ActuatorLag(DriveEffect):
    """First-order lag of commands."""

    name = "actuator_lag"
    summary = "The set point y follows the command u as time_constant dy/dt = u - y."
    source = "first-order lag, exact for commands that are held over a step; the mean over each step acts"
    signature = "rounded corners after steps of the command"
    confusions = ("actuator_delay", "joint_damping", "latency")
    requirement = WITH_THRUSTERS
    of_thrusters = True
    step_error = PHASE_ERROR
    history = 0.5

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one time constant for all."""
        return (Parameter("time_constant", "s", 0.0, 0.0, 1.0, 0.02),)

    def command(self, m: mujoco.MjModel, ctrl: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Filter the commands."""
        from scipy.signal import lfilter

        tau = float(values[0])
        if tau < 1e-5:
            return ctrl
        slow, ids = ctrl.copy(), self.ids(m)
        keep = np.exp(-m.opt.timestep / tau)
        mean = (1 - keep) * tau / m.opt.timestep
        u = ctrl[:, ids]
        before = lfilter([0, 1 - keep], [1, -keep], u - u[0], axis=0) + u[0]
        slow[:, ids] = u + (np.asarray(before) - u) * mean
        return slow

    def delay_and_lag(self, m: mujoco.MjModel, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the time constant of the targets."""
        lag = np.zeros(m.nu)
        lag[self.ids(m)] = max(float(values[0]), 0.0)
        return np.zeros(m.nu), lag


class Backlash(ServoEffect):
    """Play between drive and link."""

    name = "backlash"
    summary = (
        "The drive turns a rotor without mass, which acts on the link only where it presses on an end of the play; in "
        "between the link is free, and the rotor follows its command by kp (u - r) = kv dr/dt."
    )
    source = "play between inertias: Nordin and Gutman, Automatica 38(10), 2002; the rotor's left out"
    signature = "error that flips by the play at each reversal of the load; free swing in between"
    confusions = ("joint_friction", "stribeck_friction", "joint_compliance")

    @classmethod
    def single_targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return each of several drives: a common value is far off where one drive alone has play."""
        return each_of_several(cls.targets(m))

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Make room for how far each rotor is ahead of its link."""
        spec.nuserdata += len(spec.actuators)

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one width of the play for all."""
        slide = all(m.jnt_type[driven_joints(m, a)[0]] == int(mujoco.mjtJoint.mjJNT_SLIDE) for a in self.ids(m))
        unit, size = ("m", 0.1) if slide else ("rad", 1.0)
        scan = tuple(size * x for x in (0.005, 0.01, 0.02, 0.04, 0.08))
        return (Parameter("play", unit, 0.0, 0.0, 0.5 * size, 0.02 * size, scan=scan),)

    def force_model(self, m: mujoco.MjModel) -> ForceModel:
        """Torque that takes back the drive's within the play."""
        return BacklashForce(self.ids(m), m.nuserdata - m.nu)


class JointCompliance(ServoEffect):
    """Elasticity between rotor and link; the encoder is on the rotor's side."""

    name = "joint_compliance"
    summary = (
        "The servo turns a rotor with the joint's armature J, and a spring the link: J r'' = f(r) - T, with the torque "
        "T = (r - q) / c on the link; encoders read r. A share of the servo's damping acts on the rotor."
    )
    source = (
        "elastic joints: Spong, J. Dyn. Sys. Meas. Control 109(4), 1987; damping ratio of the rotor on its spring 0.05"
    )
    signature = "what the robot carries sags and swings; the encoder reads less of it"
    confusions = ("actuator_gain", "joint_offset", "backlash", "armature")

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Make room for the state of each rotor, and add a site and a sensor that show it."""
        spec.nuserdata += (SLOTS + 1) * len(spec.actuators)
        known = {sensor.name for sensor in spec.sensors}
        for n in self.target:
            # Else MuJoCo takes the inertia of a joint on its own as compiled, whatever its armature.
            spec.joint(spec.actuator(n).target).parent.simple = False
            name = TWIST_SENSOR.format(n)
            if name not in known:
                # Off the origin, for MuJoCo does not look at the position of a site that is compiled there.
                spec.worldbody.add_site(name=name, pos=[1.0, 0.0, 0.0], size=[1e-4, 1e-4, 1e-4], rgba=[0, 0, 0, 0])
                spec.add_sensor(
                    name=name,
                    type=mujoco.mjtSensor.mjSENS_FRAMEPOS,
                    objtype=mujoco.mjtObj.mjOBJ_SITE,
                    objname=name,
                )

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one compliance for each joint, and the share of the servos' damping that acts on the rotors.

        It is 1 for a servo that takes the speed from its rotor, 0 for one that takes it from an encoder on the link.
        """
        gains = np.array([servo_gain(m, a) for a in self.ids(m)])
        slide = all(m.jnt_type[driven_joints(m, a)[0]] == int(mujoco.mjtJoint.mjJNT_SLIDE) for a in self.ids(m))
        unit = "m/N" if slide else "rad/(N m)"
        compliances = (
            Parameter(f"compliance[{t}]", unit, 0.0, 0.0, 10 / kp, 0.2 / kp)
            for t, kp in zip(self.target, gains, strict=True)
        )
        return (*compliances, Parameter("rotor_damping", "-", 1.0, -0.5, 1.5, 0.5, is_side=True))

    def force_model(self, m: mujoco.MjModel) -> ForceModel:
        """Torque of the spring on the link."""
        kind = mujoco.mjtObj.mjOBJ_SITE
        sites = np.array([mujoco.mj_name2id(m, kind, TWIST_SENSOR.format(n)) for n in self.target])
        return ElasticGearForce(self.ids(m), sites, m.nuserdata - (SLOTS + 1) * m.nu)

    def measure(self, m: mujoco.MjModel, read: Reader, values: np.ndarray) -> Reader:
        """Let encoders read the rotor: sensors of the joint's and the actuator's position, velocity and force."""
        found: dict[str, tuple[str, int, float]] = {}
        for n, a, c in zip(self.target, self.ids(m), values[:-1], strict=True):
            joint, gear = driven_joints(m, a)[0], float(m.actuator_gear[a, 0])
            for i in range(m.nsensor if c > 0 else 0):
                kind, of = mujoco.mjtSensor(int(m.sensor_type[i])), m.sensor_objid[i]
                if kind in OF_JOINT and of == joint:
                    column = OF_JOINT[kind]
                    found[m.sensor(i).name] = TWIST_SENSOR.format(n), column, gear if column == SERVO_FORCE else 1.0
                elif kind in OF_ACTUATOR and of == a:
                    column = OF_ACTUATOR[kind]
                    found[m.sensor(i).name] = TWIST_SENSOR.format(n), column, 1.0 if column == SERVO_FORCE else gear

        def reading(sensor: str, time: np.ndarray) -> np.ndarray:
            value = read(sensor, time)
            if sensor not in found:
                return value
            twist, column, factor = found[sensor]
            shown = factor * read(twist, time)[:, column : column + 1]
            return shown if column == SERVO_FORCE else value + shown

        return reading


class GravityCompensation(Effect):
    """Error of the controller's gravity compensation."""

    name = "gravity_compensation"
    family = "joints"
    kind = "body"
    summary = "Each link is pushed up by a share of its weight, beyond what the model has."
    source = f"MuJoCo's gravcomp ({MUJOCO})"
    signature = "residual torque like the gravity load, in every pose"
    confusions = ("mass", "center_of_mass", "actuator_gain", "gravity_tilt")

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the links of the robot."""
        found = tuple(
            n for b in robot_bodies(m) if m.body_mass[b] > 0 and (n := element_name(m, mujoco.mjtObj.mjOBJ_BODY, b))
        )
        return (found,) if found else ()

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Switch compensation on, by that of the world, which it cannot move: MuJoCo does it for positive shares."""
        spec.worldbody.gravcomp = 1.0

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one share for all links: positive lifts."""
        return (Parameter("share", "-", 0.0, -1.5, 1.5, 0.1),)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Compensation."""
        return ("body_gravcomp",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Add to the compensation."""
        m.body_gravcomp[self.ids(m)] += values[0]
