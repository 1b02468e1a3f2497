"""Angles of joints that turn without end, read by instruments that begin anew after each turn.

An absolute encoder, an arctangent or a driver that keeps angles within -pi..pi jumps by a turn where a hinge passes the
end of that interval; the scene's angle does not. Such readings are continued over the jumps. They are known by what a
wrapped angle cannot do: leave an interval of one turn; and by jumps of more than two thirds of a turn between samples
next to one another, over which the continued angle moves about as fast as beside them. Set-points that step by so much,
and readings that drop out, stand still beside their jumps.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from concent_warp.errors import printable
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

TURN = 2 * np.pi


@dataclass(frozen=True)
class UnwindCfg:
    """What tells a wrapped angle from one that moves fast."""

    min_jump: float = 2 / 3
    """Least jump between samples next to one another [turns]: the motion behind it is then at most half as long."""
    max_step: float = 0.25
    """Motion between samples that 95 % of the continued angles that move keep below [turns]: noise that reaches round
    the circle, and set-points at random that are held for a while, do not."""
    max_speed_ratio: float = 3.0
    """Highest speed of most continued angles over their jumps, over the highest beside these [-]: acceleration within a
    few samples, and noise."""
    beside: int = 2
    """Steps on either side that are beside a jump, those at which the angle stands still left out [-]."""
    small_step: float = 0.02
    """Motion over a jump that is never too fast [turns]: an angle that rests at the end of a turn."""
    max_gap: float = 3.0
    """Longest time between such samples, in units of the median: in a longer gap the joint itself may have turned
    [-]."""
    tolerance: float = 0.02
    """By how much readings may leave an interval of one turn [turns]: noise that is added after the wrapping."""


def unwound(recording: Recording, cfg: UnwindCfg | None = None) -> Recording:
    """Return a recording in which angles of hinges that pass the end of a turn go on, with a warning that names them.

    Positions that are measured at hinges, and commands of position servos on them. Hinges whose range is less than a
    turn cannot pass one, and are left as they are.

    Args:
        recording: The recording, valid.
        cfg: Thresholds.
    """
    cfg = cfg or UnwindCfg()
    if not any(wraps(time, value, TURN, cfg) for d in recording.demonstrations for time, value in _numbers(d)):
        return recording  # without compiling the scene
    m = Scene(recording.scene, recording.source).model
    named: dict[str, None] = {}
    demonstrations = []
    for d in recording.demonstrations:
        measured, action, mended = dict(d.measured), dict(d.action), {}
        for name, channel in d.measured.items():
            joint = measured_hinge(m, name)
            if joint is not None and (value := _unwound(channel.time, channel.value[:, 0], cfg)) is not None:
                value = _near(value, _start(m, d, joint))
                measured[name] = mended[joint] = replace(channel, value=value[:, None])
                named[f"measured/{name}"] = None
        for name, channel in d.action.items():
            if (joint := commanded_hinge(m, name)) is None:
                continue
            value = _unwound(channel.time, channel.value, cfg)
            if value is not None:
                value = _near(value, _first(mended[joint]) if joint in mended else _measured_first(m, d, joint))
            elif joint in mended:
                value = _beside(channel, mended[joint])
            if value is not None:
                action[name] = replace(channel, value=value)
                named[f"action/{name}"] = None
        demonstrations.append(replace(d, measured=measured, action=action))
    if not named:
        return recording
    warnings.warn(
        printable(
            f"{recording.source}: angles that begin anew after each turn are continued over the jumps: "
            f"{', '.join(named)}"
        ),
        stacklevel=2,
    )
    return replace(recording, demonstrations=tuple(demonstrations))


def wraps(time: np.ndarray, value: np.ndarray, turn: float, cfg: UnwindCfg | None = None) -> bool:
    """Return whether readings of an angle begin anew after each turn.

    Args:
        time: Clock readings [s], shape (T,).
        value: Angles, shape (T,), in any unit; NaN where missing.
        turn: A full turn in that unit.
        cfg: Thresholds.
    """
    cfg, known = cfg or UnwindCfg(), np.isfinite(value)
    if known.sum() < 2 or np.ptp(value[known]) > (1 + cfg.tolerance) * turn:
        return False
    periods, steps = np.diff(time[known]), np.diff(value[known])
    near = periods <= cfg.max_gap * np.median(periods)
    moved = np.abs(steps - turn * np.round(steps / turn))
    jumps = near & (np.abs(steps) > cfg.min_jump * turn)
    moving = near & (moved > 0)
    if not jumps.any() or (moving.any() and np.quantile(moved[moving], 0.95) >= cfg.max_step * turn):
        return False
    fastest = cfg.max_speed_ratio * _speed_beside(periods, moved, jumps, moving & ~jumps, cfg.beside)
    return bool(np.mean(moved[jumps] <= np.maximum(fastest * periods[jumps], cfg.small_step * turn)) > 0.5)


def _speed_beside(
    periods: np.ndarray, moved: np.ndarray, jumps: np.ndarray, others: np.ndarray, count: int
) -> np.ndarray:
    """Return the highest speed in the steps next to each of J jumps, shape (J,); 0 without any.

    Args:
        periods: Durations of S steps [s], shape (S,).
        moved: Motion of each, shape (S,).
        jumps: Which are jumps, shape (S,) bool.
        others: Which are looked at, shape (S,) bool.
        count: How many on either side.
    """
    speed = np.pad(moved[others] / periods[others], count)
    place = np.searchsorted(np.flatnonzero(others), np.flatnonzero(jumps))
    return speed[place[:, None] + np.arange(2 * count)].max(axis=1)


def continued(value: np.ndarray) -> np.ndarray:
    """Return angles [rad], shape (T,), NaN where missing, moved by whole turns so that each is nearest to the last."""
    value, known = np.array(value, dtype=float), np.isfinite(value)
    value[known] = np.unwrap(value[known])
    return value


def _numbers(d: Demonstration) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield times and values of all commands, and of all measurements of one component."""
    for channel in d.action.values():
        yield channel.time, np.asarray(channel.value, dtype=float)
    for channel in d.measured.values():
        if channel.value.shape[1] == 1:
            yield channel.time, np.asarray(channel.value[:, 0], dtype=float)


def _unwound(time: np.ndarray, value: np.ndarray, cfg: UnwindCfg) -> np.ndarray | None:
    """Return angles [rad], shape (T,), without jumps by a turn; None where they do not begin anew after each turn."""
    value = np.array(value, dtype=float)
    if not wraps(time, value, TURN, cfg):
        return None
    return continued(value)


def _near(value: np.ndarray, start: float | None) -> np.ndarray:
    """Return angles [rad] moved by whole turns so that the first is nearest to a start; as they are without one."""
    if start is None:
        return value
    return value - TURN * np.round((value[np.isfinite(value)][0] - start) / TURN)


def _beside(command: Channel, measured: Channel) -> np.ndarray | None:
    """Return commands [rad], shape (T,), moved by the turns that they are from what was measured most of the time.

    None where they are not: a command may be beyond the end of a turn all the time, and jump nowhere.
    """
    value, row = measured.value[:, 0], np.searchsorted(command.time, measured.time, side="right") - 1
    known = np.isfinite(value) & (row >= 0)
    if not known.any():
        return None
    turns = np.round(np.median(command.value[row[known]] - value[known]) / TURN)
    return command.value - TURN * turns if turns else None


def _turns(m: mujoco.MjModel, joint: int) -> bool:
    """Return whether a joint is a hinge that can turn once round."""
    hinge = m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
    return bool(hinge and not (m.jnt_limited[joint] and np.ptp(m.jnt_range[joint]) < TURN))


def measured_hinge(m: mujoco.MjModel, sensor: str) -> int | None:
    """Return the hinge that can turn once round whose position a sensor shows."""
    row = m.sensor(sensor).id
    if m.sensor_type[row] != mujoco.mjtSensor.mjSENS_JOINTPOS:
        return None
    joint = int(m.sensor_objid[row])
    return joint if _turns(m, joint) else None


def commanded_hinge(m: mujoco.MjModel, actuator: str) -> int | None:
    """Return the hinge that can turn once round whose position an actuator without gear is commanded."""
    row = m.actuator(actuator).id
    joint = int(m.actuator_trnid[row, 0])
    on_joint = m.actuator_trntype[row] == mujoco.mjtTrn.mjTRN_JOINT and m.actuator_gear[row, 0] == 1
    affine = m.actuator_biastype[row] == mujoco.mjtBias.mjBIAS_AFFINE
    gain, bias = m.actuator_gainprm[row, 0], m.actuator_biasprm[row, 1]
    return joint if on_joint and affine and gain == -bias != 0 and _turns(m, joint) else None


def _start(m: mujoco.MjModel, d: Demonstration, joint: int) -> float | None:
    """Return the angle [rad] of a hinge that a demonstration states at its start."""
    return None if d.qpos is None else float(d.qpos[m.jnt_qposadr[joint]])


def _measured_first(m: mujoco.MjModel, d: Demonstration, joint: int) -> float | None:
    """Return the first reading [rad] of a hinge, else its stated start."""
    for name, channel in d.measured.items():
        if measured_hinge(m, name) == joint and np.isfinite(channel.value[:, 0]).any():
            return _first(channel)
    return _start(m, d, joint)


def _first(channel: Channel) -> float:
    """Return the first reading of a channel of one component."""
    value = channel.value[:, 0]
    return float(value[np.isfinite(value)][0])
