"""Effects of the instruments: clocks, scales, frames, bias. They change the readings, not the motion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.effects.effect import PHASE_ERROR, Effect, Parameter, Reader
from concent_warp.effects.select import FORCES, INERTIAL, JOINTS, POSES, sensors_by_type, shown_free_joint

SCALES = (-0.03, -0.01, 0.01, 0.03)
"""Errors of scales that are scanned [-]: an impact at another time or place is not in proportion to them."""
WEIGHT_SHARE, LEVER = 0.02, 0.1
"""Typical zero of a force cell over the weight of all bodies [-], and the lever by which that of a torque is so [m]."""
MIN_WEIGHT = 5.0
"""Weight that is taken for it at least [N]."""
BIASES = {
    int(mujoco.mjtSensor.mjSENS_GYRO): ("rad/s", 0.02),
    int(mujoco.mjtSensor.mjSENS_ACCELEROMETER): ("m/s^2", 0.2),
    int(mujoco.mjtSensor.mjSENS_VELOCIMETER): ("m/s", 0.01),
}
"""Units of inertial sensors and their typical zeros in these."""
CALIBRATION = "calibration of instruments: reading = gain true + bias, at a clock of its own"


class MeasurementEffect(Effect):
    """An effect on what some sensors read."""

    family = "measurement"
    kind = "sensor"
    source = CALIBRATION

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the poses of bodies, and the joints."""
        return instruments(m, POSES, JOINTS)


def instruments(m: mujoco.MjModel, *kinds: tuple[int, ...]) -> tuple[tuple[str, ...], ...]:
    """Return the names of the sensors of each of some kinds, where there are any: an instrument each."""
    return tuple(group for kind in kinds if (group := sensors_by_type(m, kind)))


class TimeBase(MeasurementEffect):
    """Scale error of the instrument's clock."""

    name = "time_base"
    summary = "The instrument's clock shows t (1 + scale) at time t."
    signature = "all motion faster or slower by the same share; free fall with another g"
    confusions = ("latency", "length_scale", "air_drag", "gravity_tilt")
    rarity = 4.0

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one scale."""
        return (Parameter("scale", "-", 0.0, -0.2, 0.2, 0.01, scan=SCALES),)

    def true_time(self, time: float, values: np.ndarray) -> float:
        """See `Effect.true_time`."""
        return time / (1 + float(values[0]))

    def measure(self, m: mujoco.MjModel, read: Reader, values: np.ndarray) -> Reader:  # noqa: ARG002
        """Read at the true times."""
        return lambda sensor, time: read(sensor, time / (1 + values[0]) if sensor in self.target else time)


class Latency(MeasurementEffect):
    """Readings that are older than their time stamps."""

    name = "latency"
    summary = "What is stamped t was seen at t - delay."
    signature = "residuals in proportion to velocity, at the same delay in all phases"
    confusions = ("actuator_delay", "time_base")
    step_error = PHASE_ERROR
    singles_last = True

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the poses of bodies, the joints, forces, and inertial measurements."""
        return instruments(m, POSES, JOINTS, FORCES, INERTIAL)

    @classmethod
    def single_targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return what each of several instruments reads: the sensors of one joint, or of one place."""
        found: list[tuple[str, ...]] = []
        for group in cls.targets(m):
            by_place: dict[tuple[int, int], list[str]] = {}
            for name in group:
                i = m.sensor(name).id
                by_place.setdefault((int(m.sensor_objtype[i]), int(m.sensor_objid[i])), []).append(name)
            found += map(tuple, by_place.values()) if len(by_place) > 1 else ()
        return tuple(found)

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one delay."""
        return (Parameter("delay", "s", 0.0, -0.1, 0.3, 0.01),)

    def true_time(self, time: float, values: np.ndarray) -> float:
        """See `Effect.true_time`."""
        return time - float(values[0])

    def measure(self, m: mujoco.MjModel, read: Reader, values: np.ndarray) -> Reader:  # noqa: ARG002
        """Read earlier."""
        return lambda sensor, time: read(sensor, time - values[0] if sensor in self.target else time)


class LengthScale(MeasurementEffect):
    """Scale error of measured positions."""

    name = "length_scale"
    summary = "Positions are read as the true ones times 1 + scale, from the world's origin."
    signature = "residuals in proportion to the position; resting heights off, free fall with another g"
    confusions = ("size", "time_base", "frame_offset")
    requirement = "sensors of positions in space"

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:
        """Return whether the sensor shows a position."""
        return int(m.sensor_type[i]) in POSES[:1]

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the positions of bodies."""
        group = sensors_by_type(m, POSES[:1])
        return (group,) if group else ()

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one scale."""
        return (Parameter("scale", "-", 0.0, -0.5, 0.5, 0.01, scan=SCALES),)

    def true_state(
        self, m: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Effect.true_state`."""
        qpos, qvel = qpos.copy(), qvel.copy()
        for position, velocity in _shown_places(m, self.target):
            qpos[position] /= 1 + values[0]
            qvel[velocity] /= 1 + values[0]
        return qpos, qvel

    def measure(self, m: mujoco.MjModel, read: Reader, values: np.ndarray) -> Reader:  # noqa: ARG002
        """Scale the positions."""
        return lambda sensor, time: read(sensor, time) * (1 + values[0] if sensor in self.target else 1.0)


class FrameOffset(MeasurementEffect):
    """Error of the calibrated pose of a camera."""

    name = "frame_offset"
    summary = "Poses are read in a frame shifted and turned against the world's."
    signature = "residuals that are constant in place, or turn with the distance from the origin"
    confusions = ("size", "gravity_tilt", "center_of_mass", "joint_offset")
    requirement = "sensors of positions and orientations in space"

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:
        """Return whether the sensor shows a position or an orientation."""
        return int(m.sensor_type[i]) in POSES

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the poses of bodies."""
        group = sensors_by_type(m, POSES)
        return (group,) if group else ()

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Shift, and rotation vector."""
        shift = [Parameter(axis, "m", 0.0, -0.2, 0.2, 0.003) for axis in "xyz"]
        return (*shift, *(Parameter(f"r{axis}", "rad", 0.0, -0.5, 0.5, 0.01) for axis in "xyz"))

    def true_state(
        self, m: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Effect.true_state`."""
        qpos, qvel, back = qpos.copy(), qvel.copy(), Rotation.from_rotvec(-np.asarray(values[3:]))
        for position, velocity in _shown_places(m, self.target):
            qpos[position] = back.apply(qpos[position] - values[:3])
            qvel[velocity] = back.apply(qvel[velocity])
        for place in _shown_orientations(m, self.target):
            turned = back * Rotation.from_quat(qpos[place], scalar_first=True)
            qpos[place] = turned.as_quat(scalar_first=True)
        return qpos, qvel

    def measure(self, m: mujoco.MjModel, read: Reader, values: np.ndarray) -> Reader:
        """Turn and shift the poses."""
        turn = Rotation.from_rotvec(values[3:])
        quaternions = {s for s in self.target if m.sensor(s).dim[0] == 4}

        def reading(sensor: str, time: np.ndarray) -> np.ndarray:
            value = read(sensor, time)
            if sensor not in self.target:
                return value
            if sensor not in quaternions:
                return turn.apply(value) + values[:3]
            sane = np.isfinite(value).all(axis=1) & (np.abs(value).sum(axis=1) > 0)
            turned = value.copy()
            if sane.any():
                turned[sane] = (turn * Rotation.from_quat(value[sane], scalar_first=True)).as_quat(scalar_first=True)
            return turned

        return reading


class SensorBias(MeasurementEffect):
    """Readings off by a constant."""

    name = "sensor_bias"
    summary = "A constant is added to the reading, one along each axis of a vector."
    signature = "constant residual of one sensor, with no force to go with it"
    confusions = ("joint_offset", "gravity_compensation")

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the joints' positions, forces, and inertial measurements."""
        return instruments(m, JOINTS[:1], FORCES, INERTIAL)

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return one constant for each sensor, along each of its axes."""
        found: list[Parameter] = []
        for sensor in self.elements:
            unit, scale = _typical_bias(m, sensor)
            axes = ["_x", "_y", "_z"] if _axes(m, sensor) == len("xyz") else [""]
            names = [f"bias{axis}[{sensor}]" for axis in axes]
            found += [Parameter(n, unit, 0.0, low=-50 * scale, high=50 * scale, scale=scale) for n in names]
        return tuple(found)

    def true_state(
        self, m: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Effect.true_state`."""
        qpos, biases = qpos.copy(), self._by_sensor(m, values)
        first = np.array([biases[sensor][0] for sensor in self.target])
        for place, _, bias in _shown_joints(m, self.target, first):
            qpos[place] -= bias
        return qpos, qvel

    def measure(self, m: mujoco.MjModel, read: Reader, values: np.ndarray) -> Reader:
        """Add it."""
        biases = self._by_sensor(m, values)
        return lambda sensor, time: read(sensor, time) + biases.get(sensor, 0.0)

    def _by_sensor(self, m: mujoco.MjModel, values: np.ndarray) -> dict[str, np.ndarray]:
        """Return the constants of each sensor, shape (1,) or (3,)."""
        found: dict[str, list[float]] = {}
        names = [sensor for sensor in self.target for _ in range(_axes(m, sensor))]
        for sensor, value in zip(names, values, strict=True):
            found.setdefault(sensor, []).append(float(value))
        return {sensor: np.array(bias) for sensor, bias in found.items()}


class SensorGain(MeasurementEffect):
    """Readings off by a factor."""

    name = "sensor_gain"
    summary = "The reading is the true value times 1 + scale."
    signature = "residual of one sensor in proportion to its reading"
    confusions = ("joint_compliance", "time_base")

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the joints' sensors, forces, and inertial measurements."""
        return instruments(m, JOINTS, FORCES, INERTIAL)

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one scale for each sensor."""
        return self.parameter_per_target("scale", "-", 0.0, low=-0.9, high=5.0, scale=0.03)

    def true_state(
        self, m: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Effect.true_state`."""
        qpos, qvel = qpos.copy(), qvel.copy()
        for place, dof, scale in _shown_joints(m, self.target, values):
            qpos[place] /= 1 + scale
            qvel[dof] /= 1 + scale
        return qpos, qvel

    def measure(self, m: mujoco.MjModel, read: Reader, values: np.ndarray) -> Reader:  # noqa: ARG002
        """Scale it."""
        gain = dict(zip(self.target, values, strict=True))
        return lambda sensor, time: read(sensor, time) * (1 + gain.get(sensor, 0.0))


def _shown_places(m: mujoco.MjModel, sensors: Sequence[str]) -> list[tuple[slice, slice]]:
    """Return where the state has positions and velocities of the free bodies whose positions some sensors show."""
    joints = _shown_free_joints(m, sensors, POSES[0])
    places = [(int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j])) for j in joints]
    return [(slice(p, p + 3), slice(v, v + 3)) for p, v in places]


def _shown_orientations(m: mujoco.MjModel, sensors: Sequence[str]) -> list[slice]:
    """Return where the state has the quaternions of the free bodies whose orientations some sensors show."""
    places = [int(m.jnt_qposadr[j]) for j in _shown_free_joints(m, sensors, POSES[1])]
    return [slice(p + 3, p + 7) for p in places]


def _shown_free_joints(m: mujoco.MjModel, sensors: Sequence[str], kind: int) -> list[int]:
    """Return the free joints of the bodies that some sensors of a kind show, each once."""
    rows = [m.sensor(name).id for name in sensors]
    found = {shown_free_joint(m, row) for row in rows if int(m.sensor_type[row]) == kind}
    return sorted(j for j in found if j is not None)


def _axes(m: mujoco.MjModel, sensor: str) -> int:
    """Return along how many axes a sensor reads: three as a vector, else one."""
    row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, sensor)
    return 3 if row >= 0 and m.sensor_dim[row] == len("xyz") else 1


def _typical_bias(m: mujoco.MjModel, sensor: str) -> tuple[str, float]:
    """Return the unit of what a sensor reads and how far its zero typically is off."""
    i = m.sensor(sensor).id
    kind, target = int(m.sensor_type[i]), int(m.sensor_objid[i])
    if kind in BIASES:
        return BIASES[kind]
    if kind in FORCES:
        weight = max(float(np.linalg.norm(m.opt.gravity)) * float(m.body_mass.sum()), MIN_WEIGHT)
        turns = kind == int(mujoco.mjtSensor.mjSENS_TORQUE) or _acts_on_hinge(m, kind, target)
        return ("N m", WEIGHT_SHARE * weight * LEVER) if turns else ("N", WEIGHT_SHARE * weight)
    if kind not in JOINTS:
        return "SI unit", 0.01
    position = "m" if int(m.jnt_type[target]) == mujoco.mjtJoint.mjJNT_SLIDE else "rad"
    return (position if kind == JOINTS[0] else f"{position}/s"), 0.01


def _acts_on_hinge(m: mujoco.MjModel, kind: int, target: int) -> bool:
    """Return whether a sensor reads the torque of a drive or joint, by its kind and the id of that."""
    if kind == int(mujoco.mjtSensor.mjSENS_ACTUATORFRC):
        on_joint = int(m.actuator_trntype[target]) == int(mujoco.mjtTrn.mjTRN_JOINT)
        target = int(m.actuator_trnid[target, 0]) if on_joint else -1
    elif kind != int(mujoco.mjtSensor.mjSENS_JOINTACTFRC):
        return False
    return target >= 0 and int(m.jnt_type[target]) != mujoco.mjtJoint.mjJNT_SLIDE


def _shown_joints(m: mujoco.MjModel, sensors: Sequence[str], values: np.ndarray) -> Iterator[tuple[int, int, float]]:
    """Return where the state has position and velocity of each joint whose position a sensor shows, and its value."""
    for name, value in zip(sensors, values, strict=True):
        row = m.sensor(name).id
        if int(m.sensor_type[row]) == JOINTS[0]:
            joint = int(m.sensor_objid[row])
            yield int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint]), float(value)
