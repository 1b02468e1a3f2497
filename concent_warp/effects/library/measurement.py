"""Effects of the instruments: clocks, scales, frames, bias. They change the readings, not the motion."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.effects.effect import Effect, Parameter, Reader
from concent_warp.effects.select import JOINTS, POSES, sensors_by_type

CALIBRATION = "calibration of instruments: reading = gain true + bias, at a clock of its own"


class MeasurementEffect(Effect):
    """An effect on what some sensors read."""

    family = "measurement"
    kind = "sensor"
    source = CALIBRATION

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the poses of bodies, and the joints."""
        return tuple(group for kinds in (POSES, JOINTS) if (group := sensors_by_type(m, kinds)))


class TimeBase(MeasurementEffect):
    """Scale error of the instrument's clock."""

    name = "time_base"
    summary = "The instrument's clock shows t (1 + scale) at time t."
    signature = "all motion faster or slower by the same share; free fall with another g"
    confusions = ("latency", "length_scale", "air_drag", "gravity_tilt")
    rarity = 4.0

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one scale."""
        return (Parameter("scale", "-", 0.0, -0.2, 0.2, 0.01),)

    def measure(self, m: mujoco.MjModel, read: Reader, values: np.ndarray) -> Reader:  # noqa: ARG002
        """Read at the true times."""
        return lambda sensor, time: read(sensor, time / (1 + values[0]) if sensor in self.target else time)


class Latency(MeasurementEffect):
    """Readings that are older than their time stamps."""

    name = "latency"
    summary = "What is stamped t was seen at t - delay."
    signature = "residuals in proportion to velocity, at the same delay in all phases"
    confusions = ("actuator_delay", "time_base")

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one delay."""
        return (Parameter("delay", "s", 0.0, -0.1, 0.3, 0.01),)

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
        return (Parameter("scale", "-", 0.0, -0.5, 0.5, 0.01),)

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
    summary = "A constant is added to the reading."
    signature = "constant residual of one sensor, with no force to go with it"
    confusions = ("joint_offset", "gravity_compensation")

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the joints' positions."""
        group = sensors_by_type(m, JOINTS[:1])
        return (group,) if group else ()

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one constant for each sensor."""
        return self.parameter_per_target("bias", "rad or m", 0.0, low=-0.5, high=0.5, scale=0.01)

    def measure(self, m: mujoco.MjModel, read: Reader, values: np.ndarray) -> Reader:  # noqa: ARG002
        """Add it."""
        bias = dict(zip(self.target, values, strict=True))
        return lambda sensor, time: read(sensor, time) + bias.get(sensor, 0.0)


class SensorGain(MeasurementEffect):
    """Readings off by a factor."""

    name = "sensor_gain"
    summary = "The reading is the true value times 1 + scale."
    signature = "residual of one sensor in proportion to its reading"
    confusions = ("joint_compliance", "time_base")

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the joints' sensors."""
        group = sensors_by_type(m, JOINTS)
        return (group,) if group else ()

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:  # noqa: ARG002
        """Return one scale for each sensor."""
        return self.parameter_per_target("scale", "-", 0.0, low=-0.9, high=5.0, scale=0.03)

    def measure(self, m: mujoco.MjModel, read: Reader, values: np.ndarray) -> Reader:  # noqa: ARG002
        """Scale it."""
        gain = dict(zip(self.target, values, strict=True))
        return lambda sensor, time: read(sensor, time) * (1 + gain.get(sensor, 0.0))
