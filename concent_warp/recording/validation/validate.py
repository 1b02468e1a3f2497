"""Validation of recordings, called by every reader and writer.

A recording is checked against its own scene: names and sizes against the compiled MJCF here, clocks in `clocks`,
magnitudes that indicate wrong units in `magnitudes`, cameras in `images`.

Rules on missing values: a measurement may be NaN where it is missing, but not all of a channel; infinities are refused
everywhere. A command may not be NaN at all: a command is held until the next sample, so a sample that is left out
means that the value is unchanged, and a NaN would leave the command undefined.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from concent_warp.errors import RecordingError, SceneError, printable
from concent_warp.limits import limits, raising
from concent_warp.recording.bounds import MAX_MAGNITUDE
from concent_warp.recording.naming import PREFIX
from concent_warp.recording.recording import Channel, Demonstration, PointTrack, PolicyLog, Recording
from concent_warp.recording.unwind import commanded_hinge, measured_hinge, wraps
from concent_warp.recording.validation.cfg import ValidateCfg
from concent_warp.recording.validation.clocks import check_clocks
from concent_warp.recording.validation.covariances import check_common, check_covariance
from concent_warp.recording.validation.falls import units_of_falls
from concent_warp.recording.validation.images import check_image
from concent_warp.recording.validation.location import ErrorLocation
from concent_warp.recording.validation.magnitudes import (
    check_command,
    check_lengths,
    check_measurement,
    check_positions,
)
from concent_warp.recording.validation.scene_text import check_scene_text
from concent_warp.scene.payloads import Payload
from concent_warp.scene.scene import Scene

QUATERNION_SENSORS = (int(mujoco.mjtSensor.mjSENS_FRAMEQUAT), int(mujoco.mjtSensor.mjSENS_BALLQUAT))


def validate(recording: Recording, cfg: ValidateCfg | None = None) -> None:
    """Check that a recording is consistent, fits its scene, and can be written to a file.

    Args:
        recording: The recording.
        cfg: Thresholds.

    Raises:
        RecordingError: The first thing that is wrong, with file, demonstration, channel and row (counted from 0).
    """
    check_is_recording(recording)
    model = _compile_scene(recording)
    for demonstration in recording.demonstrations:
        name = demonstration.name
        if not name.startswith(PREFIX) or "/" in name:
            raise ErrorLocation(recording.source).error(
                "a demonstration has an unusable name", expected=f"{PREFIX}0, {PREFIX}1, ...", found=repr(name)
            )
    check_contents(recording, model, cfg)


def check_contents(recording: Recording, model: mujoco.MjModel | None = None, cfg: ValidateCfg | None = None) -> None:
    """Check that a recording is consistent and fits its scene, whatever its demonstrations are called.

    It takes about 0.1 s for a million samples.

    Args:
        recording: The recording.
        model: Its compiled scene, where that is at hand.
        cfg: Thresholds.

    Raises:
        RecordingError: The first thing that is wrong, with file, demonstration, channel and row (counted from 0).
    """
    check_is_recording(recording)
    cfg = cfg or ValidateCfg()
    place = ErrorLocation(recording.source)
    model = _compile_scene(recording) if model is None else model
    if not recording.demonstrations:
        raise place.error("the recording has no demonstration", expected="at least one")
    seen: set[str] = set()
    for demonstration in recording.demonstrations:
        name = demonstration.name
        for what, text in (("name", name), ("task", "".join(demonstration.task.split()))):
            if text != printable(text):
                raise place.error(f"the {what} of a demonstration has characters that are not printable", found=text)
        if name in seen:
            raise place.error("two demonstrations have the same name", found=repr(name))
        seen.add(name)
        _check_demonstration(demonstration, model, ErrorLocation(recording.source, name), cfg)


def check_is_recording(recording: object) -> None:
    """Refuse what is no `Recording`, such as the path of one."""
    if not isinstance(recording, Recording):
        path = isinstance(recording, str | Path)
        raise RecordingError(
            "this is not a recording", where=recording if path else None, expected="a Recording",
            found=type(recording).__name__, fix="read the file with load_recording first" if path else None,
        )  # fmt: skip


def _compile_scene(recording: Recording) -> mujoco.MjModel:
    """Return the compiled scene of a recording, or raise `RecordingError`."""
    place = ErrorLocation(recording.source, channel="scene")
    check_scene_text(recording.scene, place)
    try:
        return Scene(recording.scene, recording.source).model
    except SceneError as error:
        reason = str(error).removeprefix(f"{recording.source}: ").rstrip(".")
        raise place.error(reason, fix="mend the MJCF in the recording") from None


def _check_demonstration(
    demonstration: Demonstration, model: mujoco.MjModel, place: ErrorLocation, cfg: ValidateCfg
) -> None:
    """Check one demonstration against the compiled scene."""
    if demonstration.success is not None and not isinstance(demonstration.success, bool | np.bool_):
        raise place.error("success is not a truth value", expected="True or False", found=demonstration.success)
    cfg = replace(cfg, units=units_of_falls(demonstration, model, cfg.units))
    _check_initial(demonstration, model, place, cfg)
    for name, channel in demonstration.action.items():
        _check_action(channel, model, name, place.at(f"action/{name}"), cfg)
    for name, channel in demonstration.measured.items():
        _check_measured(channel, model, name, place.at(f"measured/{name}"), cfg)
    for name, track in demonstration.points.items():
        _check_points(track, model, name, place.at(f"points/{name}"), cfg)
    for name, stream in demonstration.image.items():
        _check_time(stream.time, place.at(f"image/{name}"))
        check_image(stream, model, place.at(f"image/{name}"), cfg)
    for payload in demonstration.payloads:
        _check_payload(payload, model, place.at(f"payloads/{payload.body}"))
    if demonstration.policy is not None:
        _check_policy(demonstration.policy, place.at("policy"))
    check_clocks(demonstration, place, cfg.clocks)
    _check_duration(demonstration, model.opt.timestep, place)


def _check_payload(payload: Payload, model: mujoco.MjModel, place: ErrorLocation) -> None:
    """Check that a body that moves carries a payload, and that its numbers make sense."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, payload.body)
    moving = [model.body(b).name for b in range(model.nbody) if model.body_weldid[b]]
    if body < 0 or not model.body_weldid[body]:
        raise place.error("a payload on nothing that moves", expected=f"one of {moving}", found=payload.body)
    if not (0 < payload.mass < MAX_MAGNITUDE):
        raise place.error("the mass of a payload makes no sense", expected="a number above 0", found=payload.mass)
    if not np.all(np.abs(payload.position) < MAX_MAGNITUDE):
        raise place.error("the position of a payload makes no sense", found=list(payload.position))
    moments = np.array(payload.inertia)
    if not (np.all((moments >= 0) & (moments < MAX_MAGNITUDE)) and 2 * moments.max() <= moments.sum() * (1 + 1e-9)):
        raise place.error(
            "no body has such moments of inertia",
            expected="three numbers, none below 0, and none above the sum of the others",
            found=list(payload.inertia),
        )


def _check_duration(demonstration: Demonstration, timestep: float, place: ErrorLocation) -> None:
    """Refuse a demonstration that lasts longer, or takes more steps [s] of its scene, than the limits allow."""
    channels = {kind: getattr(demonstration, kind) for kind in ("action", "measured", "points", "image")}
    ends = {f"{k}/{n}": float(s.time[-1]) for k, streams in channels.items() for n, s in streams.items()}
    name = max(ends, key=lambda n: ends[n])
    for limit, found, unit in (("duration", ends[name], "s"), ("steps", ends[name] / timestep, "steps of the scene")):
        if found > (most := getattr(limits(), limit)):
            raise place.at(name).error(
                "the demonstration is too long to be simulated",
                expected=f"at most {most:,.0f} {unit}",
                found=f"a sample at {ends[name]:,.6g} s",
                fix=f"check the time of the last sample; {raising(limit)}",
            )


def _check_initial(demonstration: Demonstration, model: mujoco.MjModel, place: ErrorLocation, cfg: ValidateCfg) -> None:
    """Check the state at time 0: sizes, finite values, unit quaternions, units."""
    for name, value, size in (("qpos", demonstration.qpos, model.nq), ("qvel", demonstration.qvel, model.nv)):
        if value is None:
            continue
        _check_shape(value, (size,), place.at(f"initial/{name}"), fix=f"write one number per {name} of the scene")
        _check_finite(value, place.at(f"initial/{name}"), missing_allowed=False)
    if demonstration.qpos is None:
        return
    qpos = np.asarray(demonstration.qpos, dtype=float)
    for joint in range(model.njnt):
        free = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        if not free and model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_BALL:
            continue
        start = model.jnt_qposadr[joint] + (3 if free else 0)
        norm = float(np.linalg.norm(qpos[start : start + 4]))
        if abs(norm - 1) > cfg.quaternion_tolerance:
            raise place.at("initial/qpos").error(
                f"the quaternion of joint {model.joint(joint).name!r} is not of unit length",
                row=int(start),
                expected=f"norm 1 within {cfg.quaternion_tolerance}",
                found=f"{norm:.4g}",
                fix="write w, x, y, z after the three positions of a free joint",
            )
    check_positions(qpos, model, place.at("initial/qpos"), cfg.units)


def _check_action(channel: Channel, model: mujoco.MjModel, name: str, place: ErrorLocation, cfg: ValidateCfg) -> None:
    """Check one commanded channel."""
    row = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)
    if row < 0:
        known = [model.actuator(i).name for i in range(model.nu)]
        raise place.error("the scene has no such actuator", expected=_one_of(known), found=repr(name))
    _check_time(channel.time, place)
    _check_shape(channel.value, (len(channel.time),), place, fix="write one command per time")
    _check_finite(channel.value, place, missing_allowed=False)
    if channel.covariance is not None or channel.common is not None:
        raise place.error("a command has no covariance", fix="leave it out")
    check_command(np.asarray(channel.value), model, row, place, cfg.units)
    if commanded_hinge(model, name) is not None:
        _check_turns(np.asarray(channel.time), np.asarray(channel.value), place)


def _check_measured(channel: Channel, model: mujoco.MjModel, name: str, place: ErrorLocation, cfg: ValidateCfg) -> None:
    """Check one measured channel."""
    row = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
    if row < 0:
        known = [model.sensor(i).name for i in range(model.nsensor)]
        raise place.error("the scene has no such sensor", expected=_one_of(known), found=repr(name))
    _check_time(channel.time, place)
    _check_shape(
        channel.value,
        (len(channel.time), int(model.sensor_dim[row])),
        place,
        fix="write one row per time and one column per number of the sensor",
    )
    _check_finite(channel.value, place, missing_allowed=True)
    value = np.asarray(channel.value)
    if channel.noise_std is not None and not 0 <= channel.noise_std <= MAX_MAGNITUDE:
        raise place.error("noise_std is not a standard deviation", expected=">= 0", found=channel.noise_std)
    quaternion = model.sensor_type[row] in QUATERNION_SENSORS
    if channel.covariance is not None:
        check_covariance(channel.covariance, value, 3 if quaternion else value.shape[1], place)
    if channel.common is not None:
        check_common(channel.common, channel.covariance, value, place)
    if quaternion:
        _check_quaternions(value, place, cfg)
    check_measurement(value, model, row, place, cfg.units)
    if measured_hinge(model, name) is not None:
        _check_turns(np.asarray(channel.time), value[:, 0], place)


def _check_points(track: PointTrack, model: mujoco.MjModel, name: str, place: ErrorLocation, cfg: ValidateCfg) -> None:
    """Check the tracked points of one body."""
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) < 0:
        known = [model.body(i).name for i in range(1, model.nbody)]
        raise place.error("the scene has no such body", expected=_one_of(known), found=repr(name))
    _check_time(track.time, place)
    shape = np.shape(track.value)
    if len(shape) != 3 or shape[2] != 3 or shape[0] != len(track.time) or shape[1] == 0:
        raise place.error("wrong shape of the points", expected=f"({len(track.time)}, M, 3)", found=shape)
    if np.shape(track.visible) != shape[:2] or np.asarray(track.visible).dtype != bool:
        found = f"{np.shape(track.visible)} {np.asarray(track.visible).dtype}"
        raise place.error("visible does not fit the points", expected=f"{shape[:2]} bool", found=found)
    _check_finite(track.value, place, missing_allowed=True)
    seen = np.asarray(track.visible)
    if not seen.any():
        raise place.error("no point is visible in any frame", fix="leave the channel out")
    lost = seen & np.isnan(track.value).any(axis=2)
    if lost.any():
        row, point = np.argwhere(lost)[0]
        raise place.error(f"point {point} is visible but has no position", row=int(row), found="NaN")
    check_lengths(np.linalg.norm(np.asarray(track.value)[seen], axis=1), model, place, cfg.units)


def _check_policy(log: PolicyLog, place: ErrorLocation) -> None:
    """Check what a policy observed and did."""
    _check_time(log.time, place)
    for name, value in (("observation", log.observation), ("action", log.action)):
        shape = np.shape(value)
        if len(shape) != 2 or shape[0] != len(log.time) or not shape[1]:
            raise place.error(f"wrong shape of {name}", expected=f"({len(log.time)}, size)", found=shape)
        _check_finite(value, place, missing_allowed=False)


def _check_time(time: np.ndarray, place: ErrorLocation) -> None:
    """Check clock readings [s], shape (T,): finite, not negative, strictly increasing."""
    time = np.asarray(time)
    if time.ndim != 1 or time.dtype.kind not in "fiu":
        raise place.error("wrong shape of time", expected="(T,) numbers", found=f"{time.shape} {time.dtype}")
    if not 0 < len(time) <= limits().samples:
        raise place.error(
            "wrong number of samples", expected=f"1 to {limits().samples}", fix=raising("samples"), found=len(time)
        )
    if (bad := _first(~(np.abs(time) <= MAX_MAGNITUDE))) is not None:
        if np.isfinite(time[bad]):
            found = f"{time[bad]:.4g}"
            fix = "write seconds from the start of the demonstration"
            raise place.error("its time looks like ms, us or ns", row=bad, expected="seconds", found=found, fix=fix)
        raise place.error("time is not finite", row=bad, expected="seconds", found=time[bad])
    if time[0] < 0:
        raise place.error("time is negative", row=0, expected=">= 0 s", found=f"{time[0]:g} s", fix="count from 0")
    if (bad := _first(time[1:] <= time[:-1])) is not None:
        raise place.error(
            "time does not increase",
            row=bad + 1,
            expected=f"more than {time[bad]:.9g} s",
            found=f"{time[bad + 1]:.9g} s",
            fix="sort the samples and drop repeated ones",
        )


def _check_shape(value: np.ndarray, shape: tuple[int, ...], place: ErrorLocation, fix: str) -> None:
    """Check that values are numbers of a given shape."""
    found = np.asarray(value)
    if found.shape != shape or found.dtype.kind not in "fiu":
        kind = "" if found.dtype.kind in "fiu" else f" {found.dtype}"
        raise place.error("wrong shape of the values", expected=shape, found=f"{found.shape}{kind}", fix=fix)


def _check_finite(value: np.ndarray, place: ErrorLocation, *, missing_allowed: bool) -> None:
    """Refuse infinities, a channel without any value and, unless `missing_allowed`, every NaN."""
    value = np.asarray(value, dtype=float)
    if (bad := _first(np.abs(value) > MAX_MAGNITUDE)) is not None:
        found = value.reshape(len(value), -1)[bad]
        raise place.error(
            "a value is infinite" if np.isinf(found).any() else "a value is absurdly large",
            row=bad,
            expected="finite, or NaN where missing",
            found=f"{found[np.nanargmax(np.abs(found))]:g}",
        )
    missing = np.isnan(value)
    if missing.all():
        raise place.error("every value is missing", expected="numbers", found="only NaN", fix="leave the channel out")
    if not missing_allowed and (bad := _first(missing)) is not None:
        run = int(missing.reshape(len(value), -1).any(axis=1).sum())
        raise place.error(
            f"{run} of {len(value)} values are missing",
            row=bad,
            expected="a number",
            found="NaN",
            fix="leave the samples out, so that the value before them stays in force",
        )


def _check_turns(time: np.ndarray, value: np.ndarray, place: ErrorLocation) -> None:
    """Refuse angles, shape (T,), of a hinge without end that begin anew after each 360."""
    if wraps(time, np.asarray(value, dtype=float), 360.0):
        raise place.error(
            "its values look like degrees",
            expected="rad, which begin anew after 6.283 or never",
            found=f"{np.nanmin(value):.4g} to {np.nanmax(value):.4g}, with jumps of 360",
            fix="write radians",
        )


def _check_quaternions(value: np.ndarray, place: ErrorLocation, cfg: ValidateCfg) -> None:
    """Check quaternions, shape (T, 4): whole or missing, and of unit length."""
    missing = np.count_nonzero(np.isnan(value), axis=1)
    if (bad := _first((missing > 0) & (missing < 4))) is not None:
        raise place.error("a quaternion is missing in part", row=bad, expected="four numbers or four NaN")
    norm = np.sqrt((value**2).sum(axis=1))
    if (bad := _first(np.asarray(np.abs(norm - 1) > cfg.quaternion_tolerance))) is not None:
        raise place.error(
            "a quaternion is not of unit length",
            row=bad,
            expected=f"norm 1 within {cfg.quaternion_tolerance}",
            found=f"{norm[bad]:.4g}",
            fix="write w, x, y, z",
        )


def _first(wrong: np.ndarray) -> int | None:
    """Return the first row of an array of any shape that holds a True, or None."""
    rows = np.flatnonzero(wrong.reshape(len(wrong), -1).any(axis=1)) if wrong.size else np.empty(0, int)
    return int(rows[0]) if len(rows) else None


def _one_of(names: list[str], limit: int = 12) -> str:
    """Return a list of known names for a message, cut at `limit`."""
    named = [name for name in names if name]
    if not named:
        return "none, for the scene names none"
    return f"one of {named[:limit]}" + (f" and {len(named) - limit} more" if len(named) > limit else "")
