"""Hidden effects of the sensors: recorded values differ from the true ones."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.reality.hidden.hidden_effect import Builder, HiddenEffectOfRig, true_values
from concent_warp.reality.rigs.rig import Rig
from concent_warp.reality.world import HiddenEffect

SENSOR = mujoco.mjtSensor
POSES = (SENSOR.mjSENS_FRAMEPOS, SENSOR.mjSENS_FRAMEQUAT)
Written = tuple[np.ndarray, np.ndarray]
"""Times (T,) [s] and values (T, dim)."""


def sensors_of_kinds(rig: Rig, *kinds: mujoco.mjtSensor) -> tuple[str, ...]:
    """Return the sensors of some kinds."""
    m = rig.scene.model
    return tuple(m.sensor(i).name for i in range(m.nsensor) if SENSOR(int(m.sensor_type[i])) in kinds)


def clock_channels(rig: Rig) -> tuple[str, ...]:
    """Return the channels whose clock may be wrong: the tracker's where an object is tracked, else the encoders'."""
    return (
        sensors_of_kinds(rig, *POSES)
        if rig.body_tracked
        else sensors_of_kinds(rig, SENSOR.mjSENS_JOINTPOS, SENSOR.mjSENS_JOINTVEL)
    )


def time_base(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of a clock that runs fast by a share [-]."""
    wrong = clock_channels(rig)

    def measure(name: str, time: np.ndarray, value: np.ndarray) -> Written:
        return (time * (1 + magnitude) if name in wrong else time), value

    return HiddenEffectOfRig("time_base", HiddenEffect("time_base", measure=measure), {"scale": magnitude}, wrong)


def latency(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of readings stamped too late [s]; those before the recording are lost."""
    wrong = clock_channels(rig)

    def measure(name: str, time: np.ndarray, value: np.ndarray) -> Written:
        return (time + magnitude if name in wrong else time), value

    return HiddenEffectOfRig("latency", HiddenEffect("latency", measure=measure), {"delay": magnitude}, wrong)


def length_scale(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of positions too large by a share [-]."""
    wrong = sensors_of_kinds(rig, SENSOR.mjSENS_FRAMEPOS)

    def measure(name: str, time: np.ndarray, value: np.ndarray) -> Written:
        return time, value * (1 + magnitude) if name in wrong else value

    return HiddenEffectOfRig("length_scale", HiddenEffect("length_scale", measure=measure), {"scale": magnitude}, wrong)


def frame_offset(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of a tracker shifted [m] along x, -y and half along z, and turned against its calibration."""
    shift = magnitude * np.array([1.0, -1.0, 0.5])
    turn = magnitude * 3.0 * np.array([1.0, 0.5, -1.0])
    rotation = Rotation.from_rotvec(turn)
    wrong = sensors_of_kinds(rig, *POSES)

    def measure(name: str, time: np.ndarray, value: np.ndarray) -> Written:
        if name not in wrong:
            return time, value
        if value.shape[1] == 3:
            return time, rotation.apply(value) + shift
        return time, (rotation * Rotation.from_quat(value, scalar_first=True)).as_quat(scalar_first=True)

    axes: tuple[str, ...] = ("x", "y", "z", "rx", "ry", "rz")
    truth: dict[str, float] = dict(zip(axes, map(float, (*shift, *turn)), strict=True))
    return HiddenEffectOfRig("frame_offset", HiddenEffect("frame_offset", measure=measure), truth, wrong)


def sensor_bias(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of encoders that read too much by a constant [rad or m]."""
    wrong = sensors_of_kinds(rig, SENSOR.mjSENS_JOINTPOS)

    def measure(name: str, time: np.ndarray, value: np.ndarray) -> Written:
        return time, value + magnitude if name in wrong else value

    truth = true_values("bias", wrong, np.full(len(wrong), magnitude))
    return HiddenEffectOfRig("sensor_bias", HiddenEffect("sensor_bias", measure=measure), truth, wrong)


def sensor_gain(rig: Rig, magnitude: float) -> HiddenEffectOfRig:
    """Return the effect of encoders that read too much by a share [-]."""
    wrong = sensors_of_kinds(rig, SENSOR.mjSENS_JOINTPOS, SENSOR.mjSENS_JOINTVEL)

    def measure(name: str, time: np.ndarray, value: np.ndarray) -> Written:
        return time, value * (1 + magnitude) if name in wrong else value

    truth = true_values("scale", wrong, np.full(len(wrong), magnitude))
    return HiddenEffectOfRig("sensor_gain", HiddenEffect("sensor_gain", measure=measure), truth, wrong)


MEASUREMENT: dict[str, Builder] = {
    f.__name__: f for f in (time_base, latency, length_scale, frame_offset, sensor_bias, sensor_gain)
}
