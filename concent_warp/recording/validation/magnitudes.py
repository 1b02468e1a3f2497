"""Magnitudes that only a wrong unit explains: millimetres for metres, degrees for radians.

The bounds (`UnitCheckCfg`) are far outside the values of a sound recording, and they grow with the scene:

- positions: the lower quartile of the distances from the origin is above both `max_distance` and `max_extents` times
  the extent of the scene. An object that starts near the scene and flies or falls far away stays below it; one that
  falls from far above is allowed by `falls`.
- joint angles, and those commanded of a position servo: more than `max_turn` outside the joint's range. Angles of
  joints without limits cannot be judged and are not.
- joint slides, commanded or measured: more than `max_slide`, and more than `max_slide_ranges` times the range, outside
  the joint's range; without limits, as distances from the origin.
- tendons over joints of one kind: the same, with the range that the joints give them.
- speeds: above `max_speed`.
"""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.recording.validation.cfg import UnitCheckCfg
from concent_warp.recording.validation.location import ErrorLocation

# As numbers: an element of `sensor_type` equals a member of `mjtSensor`, but is not found in a tuple of them.
POSITION_SENSORS = (int(mujoco.mjtSensor.mjSENS_FRAMEPOS), int(mujoco.mjtSensor.mjSENS_SUBTREECOM))
DISTANCE_SENSORS = (int(mujoco.mjtSensor.mjSENS_RANGEFINDER), int(mujoco.mjtSensor.mjSENS_GEOMDIST))
SPEED_SENSORS = (
    int(mujoco.mjtSensor.mjSENS_FRAMELINVEL),
    int(mujoco.mjtSensor.mjSENS_VELOCIMETER),
    int(mujoco.mjtSensor.mjSENS_SUBTREELINVEL),
)


def max_distance(model: mujoco.MjModel, cfg: UnitCheckCfg) -> float:
    """Return the distance [m] above which positions in this scene cannot be metres."""
    return max(cfg.max_distance, cfg.max_extents * float(model.stat.extent))


def check_lengths(length: np.ndarray, model: mujoco.MjModel, place: ErrorLocation, cfg: UnitCheckCfg) -> None:
    """Check distances from the origin, or between things, [m], shape (n,), NaN where missing."""
    length = length[np.isfinite(length)]
    if len(length) and (quartile := float(np.quantile(length, 0.25))) > max_distance(model, cfg):
        raise place.error(
            "its positions look like millimetres",
            expected=f"metres, three quarters of them not beyond {max_distance(model, cfg):.3g} m",
            found=f"{quartile:.4g} m",
            fix="write metres",
        )


def _known_length(value: np.ndarray) -> np.ndarray:
    """Return the lengths of vectors (T, 3) as far as their components are known, NaN where none is, shape (T,)."""
    length = np.linalg.norm(value, axis=1)
    part = np.isnan(length) & np.isfinite(value).any(axis=1)
    length[part] = np.sqrt(np.nansum(value[part] ** 2, axis=1))
    return length


def check_positions(qpos: np.ndarray, model: mujoco.MjModel, place: ErrorLocation, cfg: UnitCheckCfg) -> None:
    """Check the units of an initial state [m, rad], shape (nq,)."""
    for joint in range(model.njnt):
        start = model.jnt_qposadr[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            check_lengths(np.linalg.norm(qpos[None, start : start + 3], axis=1), model, place, cfg)
        else:
            _check_joint(qpos[start : start + 1], model, joint, place, cfg)


def check_measurement(
    value: np.ndarray, model: mujoco.MjModel, sensor: int, place: ErrorLocation, cfg: UnitCheckCfg
) -> None:
    """Check the unit of a measured channel, shape (T, dim)."""
    kind = model.sensor_type[sensor]
    if kind in POSITION_SENSORS:
        check_lengths(_known_length(value), model, place, cfg)
    elif kind in DISTANCE_SENSORS:
        check_lengths(np.abs(value[:, 0]), model, place, cfg)
    elif kind == mujoco.mjtSensor.mjSENS_JOINTPOS:
        _check_joint(value[:, 0], model, int(model.sensor_objid[sensor]), place, cfg)
    elif kind == mujoco.mjtSensor.mjSENS_TENDONPOS:
        _check_tendon(value[:, 0], model, int(model.sensor_objid[sensor]), place, cfg)
    elif kind in SPEED_SENSORS:
        speed = np.linalg.norm(np.nan_to_num(value), axis=1)
        row = int(speed.argmax())
        if speed[row] > cfg.max_speed:
            raise place.error(
                "its speeds look like millimetres per second",
                row=row,
                expected=f"metres per second, at most {cfg.max_speed:g} m/s",
                found=f"{speed[row]:.4g} m/s",
                fix="write m/s",
            )


def check_command(
    value: np.ndarray, model: mujoco.MjModel, actuator: int, place: ErrorLocation, cfg: UnitCheckCfg
) -> None:
    """Check the unit of the commands of a position servo, shape (T,); other actuators are not judged."""
    gain, bias = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator, 1]
    servo = model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE and gain == -bias != 0
    if not servo or model.actuator_gear[actuator, 0] != 1:
        return
    target = int(model.actuator_trnid[actuator, 0])
    if model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT:
        _check_joint(value, model, target, place, cfg)
    elif model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_TENDON:
        _check_tendon(value, model, target, place, cfg)


def _check_joint(value: np.ndarray, model: mujoco.MjModel, joint: int, place: ErrorLocation, cfg: UnitCheckCfg) -> None:
    """Check positions of a hinge [rad] or slide [m], shape (T,), against its range, where it has one."""
    if model.jnt_limited[joint]:
        low, high = (float(bound) for bound in model.jnt_range[joint])
        _check_range(value, low, high, int(model.jnt_type[joint]), f"joint {model.joint(joint).name!r}", place, cfg)
    elif model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
        check_lengths(np.abs(value), model, place, cfg)


def _check_tendon(
    value: np.ndarray, model: mujoco.MjModel, tendon: int, place: ErrorLocation, cfg: UnitCheckCfg
) -> None:
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
        _check_range(value, low, high, kinds.pop(), f"tendon {model.tendon(tendon).name!r}", place, cfg)


def _check_range(
    value: np.ndarray, low: float, high: float, kind: int, name: str, place: ErrorLocation, cfg: UnitCheckCfg
) -> None:
    """Check positions [rad or m], shape (T,), of a hinge or slide joint, or a tendon over some, of a given range."""
    if kind == mujoco.mjtJoint.mjJNT_HINGE:
        allowed, guess, unit, fix = cfg.max_turn, "degrees", "rad", "write radians"
    elif kind == mujoco.mjtJoint.mjJNT_SLIDE:
        allowed = max(cfg.max_slide, cfg.max_slide_ranges * (high - low))
        guess, unit, fix = "millimetres", "m", "write metres"
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
