"""Magnitudes that only a wrong unit explains: millimetres for metres, degrees for radians.

The bounds are far outside what a sound recording holds, and they grow with the scene:

- positions: the lower quartile of the distances from the origin is above both 20 m and 50 times the extent of the
  scene. What starts near the scene and flies or falls far away stays below it.
- joint angles, and those commanded of a position servo: more than a full turn outside the joint's range. Encoders that
  wrap stay below it; angles of joints without limits cannot be judged and are not.
- joint slides, commanded or measured: more than 1 m, and more than 5 ranges, outside the joint's range.
- tendons over joints of one kind: the same, with the range that the joints give them.
- speeds: above 340 m/s.
"""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.recording.validation.location import ErrorLocation

FAR = 20.0
"""Distance [m] that is never refused."""
FAR_EXTENTS = 50.0
"""Distance in extents of the scene that is never refused."""
TURN = 2 * np.pi
"""How far outside its range a joint angle may read [rad]."""
SLIDE = 1.0
"""How far outside its range a joint slide may always read [m]."""
SLIDE_RANGES = 5.0
"""How far outside its range a joint slide may read, in ranges."""
FAST = 340.0
"""Speed above which a measurement is refused [m/s]."""

# As numbers: an element of `sensor_type` equals a member of `mjtSensor`, but is not found in a tuple of them.
POSITION_SENSORS = (int(mujoco.mjtSensor.mjSENS_FRAMEPOS), int(mujoco.mjtSensor.mjSENS_SUBTREECOM))
DISTANCE_SENSORS = (int(mujoco.mjtSensor.mjSENS_RANGEFINDER), int(mujoco.mjtSensor.mjSENS_GEOMDIST))
SPEED_SENSORS = (
    int(mujoco.mjtSensor.mjSENS_FRAMELINVEL),
    int(mujoco.mjtSensor.mjSENS_VELOCIMETER),
    int(mujoco.mjtSensor.mjSENS_SUBTREELINVEL),
)


def _far(model: mujoco.MjModel) -> float:
    """Return the distance [m] above which positions in this scene cannot be metres."""
    return max(FAR, FAR_EXTENTS * float(model.stat.extent))


def check_lengths(length: np.ndarray, model: mujoco.MjModel, place: ErrorLocation) -> None:
    """Check distances from the origin, or between things, [m], shape (n,), NaN where missing."""
    length = length[np.isfinite(length)]
    if len(length) and (quartile := float(np.quantile(length, 0.25))) > _far(model):
        raise place.error(
            "its positions look like millimetres",
            expected=f"metres, three quarters of them not beyond {_far(model):.3g} m",
            found=f"{quartile:.4g} m",
            fix="write metres",
        )


def check_positions(qpos: np.ndarray, model: mujoco.MjModel, place: ErrorLocation) -> None:
    """Check the units of an initial state [m, rad], shape (nq,)."""
    for joint in range(model.njnt):
        start = model.jnt_qposadr[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            check_lengths(np.linalg.norm(qpos[None, start : start + 3], axis=1), model, place)
        else:
            _check_joint(qpos[start : start + 1], model, joint, place)


def check_measurement(value: np.ndarray, model: mujoco.MjModel, sensor: int, place: ErrorLocation) -> None:
    """Check the unit of a measured channel, shape (T, dim)."""
    kind = model.sensor_type[sensor]
    if kind in POSITION_SENSORS:
        check_lengths(np.linalg.norm(value, axis=1), model, place)
    elif kind in DISTANCE_SENSORS:
        check_lengths(np.abs(value[:, 0]), model, place)
    elif kind == mujoco.mjtSensor.mjSENS_JOINTPOS:
        _check_joint(value[:, 0], model, int(model.sensor_objid[sensor]), place)
    elif kind == mujoco.mjtSensor.mjSENS_TENDONPOS:
        _check_tendon(value[:, 0], model, int(model.sensor_objid[sensor]), place)
    elif kind in SPEED_SENSORS:
        speed = np.linalg.norm(np.nan_to_num(value), axis=1)
        row = int(speed.argmax())
        if speed[row] > FAST:
            raise place.error(
                "its speeds look like millimetres per second",
                row=row,
                expected=f"metres per second, at most {FAST:g} m/s",
                found=f"{speed[row]:.4g} m/s",
                fix="write m/s",
            )


def check_command(value: np.ndarray, model: mujoco.MjModel, actuator: int, place: ErrorLocation) -> None:
    """Check the unit of the commands of a position servo, shape (T,); other actuators are not judged."""
    gain, bias = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator, 1]
    servo = model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE and gain == -bias != 0
    if not servo or model.actuator_gear[actuator, 0] != 1:
        return
    target = int(model.actuator_trnid[actuator, 0])
    if model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT:
        _check_joint(value, model, target, place)
    elif model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_TENDON:
        _check_tendon(value, model, target, place)


def _check_joint(value: np.ndarray, model: mujoco.MjModel, joint: int, place: ErrorLocation) -> None:
    """Check positions of a hinge [rad] or slide [m], shape (T,), against its range, where it has one."""
    if model.jnt_limited[joint]:
        low, high = (float(bound) for bound in model.jnt_range[joint])
        _check_range(value, low, high, int(model.jnt_type[joint]), f"joint {model.joint(joint).name!r}", place)


def _check_tendon(value: np.ndarray, model: mujoco.MjModel, tendon: int, place: ErrorLocation) -> None:
    """Check lengths of a fixed tendon, shape (T,), against what the ranges of its joints allow.

    The joints must all be limited and of one type.
    """
    rows = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    if (model.wrap_type[rows] != mujoco.mjtWrap.mjWRAP_JOINT).any():
        return
    joints = model.wrap_objid[rows]
    kinds = set(model.jnt_type[joints].tolist())
    if len(kinds) == 1 and model.jnt_limited[joints].all():
        ends = model.wrap_prm[rows, None] * model.jnt_range[joints]
        low, high = float(ends.min(axis=1).sum()), float(ends.max(axis=1).sum())
        _check_range(value, low, high, kinds.pop(), f"tendon {model.tendon(tendon).name!r}", place)


def _check_range(value: np.ndarray, low: float, high: float, kind: int, name: str, place: ErrorLocation) -> None:
    """Check positions [rad or m], shape (T,), of a hinge or slide joint, or a tendon over some, of a given range."""
    if kind == mujoco.mjtJoint.mjJNT_HINGE:
        allowed, guess, unit, fix = TURN, "degrees", "rad", "write radians"
    elif kind == mujoco.mjtJoint.mjJNT_SLIDE:
        allowed, guess, unit, fix = max(SLIDE, SLIDE_RANGES * (high - low)), "millimetres", "m", "write metres"
    else:
        return
    outside = np.nan_to_num(np.maximum(low - value, value - high))
    row = int(outside.argmax())
    if outside[row] > allowed:
        raise place.error(
            f"its values look like {guess}",
            row=row,
            expected=f"near the range {low:.4g} to {high:.4g} {unit} of {name}",
            found=f"{value[row]:.4g}",
            fix=fix,
        )
