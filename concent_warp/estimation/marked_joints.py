"""Positions of joints that no sensor measured and that poses of the bodies on them tell: a pendulum with markers.

At each time the residuals of the positions and orientations that were read are brought down by Gauss and Newton's steps
of these joints, from the solution at the time before. At the first time several starts are tried, since a hinge may
stand anywhere. Joints that have sensors of their own are where these say.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.checks import Count, Positive, Share
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.sensor_frame import SensorFrame, sensor_frame

PLACE, TURN = int(mujoco.mjtSensor.mjSENS_FRAMEPOS), int(mujoco.mjtSensor.mjSENS_FRAMEQUAT)


@dataclass(frozen=True)
class MarkedJointCfg:
    """How joints are solved for."""

    max_steps: Count = 30
    """Most steps at one time [-]."""
    max_step: Positive = 0.5
    """Largest step of a joint [m or rad]."""
    tolerance: Positive = 1e-7
    """Step below which a solution has converged [m or rad]."""
    max_residual: Positive = 0.1
    """Root mean square of the residuals above which a time is left out [m or rad]: far more than noise, and than what a
    wrong length of a link leaves."""
    min_singular: Positive = 3e-3
    """Smallest singular value of the readings' derivatives that determine the joints [m/rad or -]: a lever of 3 mm."""
    starts: Sequence[float] = (0.0, 2 * math.pi / 3, -2 * math.pi / 3)
    """Angles from the reference pose that are tried of each hinge at the first time [rad]."""
    max_starts: Count = 81
    """Most combinations of these [-]."""
    max_rate: Positive = 250.0
    """Highest rate at which joints are solved for [Hz]."""
    max_gap: Positive = 3.0
    """Longest time between readings of a second marker that are interpolated, in units of their median [-]."""
    min_share: Share = 0.5
    """Least share of the times at which the joints must be found [-]."""


@dataclass(frozen=True)
class KnownJoints:
    """Joints that other sensors tell."""

    dof: np.ndarray
    """Their degrees of freedom, hinges and slides, shape (K,)."""
    estimate: Callable[[np.ndarray], np.ndarray]
    """Returns their positions [m or rad] at times (T,) [s], shape (T, K)."""


@dataclass(frozen=True)
class _Mark:
    """Readings of one frame at common times."""

    frame: SensorFrame
    turn: bool
    """Whether they are orientations."""
    value: np.ndarray
    """Shape (T, 3), or (T, 4) of orientations, NaN where missing."""


def marked_joints(
    m: mujoco.MjModel,
    demonstration: Demonstration,
    dofs: np.ndarray,
    known: KnownJoints | None = None,
    cfg: MarkedJointCfg | None = None,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return times [s], shape (T,), and positions of joints at these, shape (T, U), from poses of bodies on them.

    Args:
        m: The compiled scene.
        demonstration: What was measured.
        dofs: Degrees of freedom of the joints to be found, hinges and slides, shape (U,).
        known: The joints that other sensors tell; without them bodies on any others say nothing here.
        cfg: Settings.

    Returns:
        NaN for joints that no pose depends on; None where that holds for all, or where those that were read do not
        determine the others most of the time.
    """
    cfg = cfg or MarkedJointCfg()
    others = set() if known is None else {int(dof) for dof in known.dof}
    channels = _frames(m, demonstration, {int(dof) for dof in dofs}, others)
    if not channels:
        return None
    told = {int(m.jnt_dofadr[j]) for frame, _, _ in channels for j in joints_below(m, frame.body)}
    mine = np.isin(dofs, list(told))
    time = max((c.time[np.isfinite(c.value).any(axis=1)] for _, _, c in channels), key=len)
    if len(time) < 2:
        return None
    rate = 1 / float(np.median(np.diff(time)))
    time = time[:: max(math.ceil(rate / cfg.max_rate - 1e-6), 1)]
    marks = [_Mark(frame, turn, _at(channel, time, turn, cfg)) for frame, turn, channel in channels]
    if known is None:
        known = KnownJoints(np.zeros(0, dtype=int), lambda at: np.zeros((len(at), 0)))
    solver, found = _Solver(m, marks, dofs[mine], known, time, cfg), np.full((len(time), len(dofs)), np.nan)
    start: np.ndarray | None = None
    for k in range(len(time)):
        found[k, mine], start = solver.at(k, start)
    seen = np.isfinite(found[:, mine]).all(axis=1)
    return (time[seen], found[seen]) if seen.mean() >= cfg.min_share and seen.sum() > 1 else None


def joints_below(m: mujoco.MjModel, body: int) -> list[int]:
    """Return the joints between the world and a body, those of the body itself first."""
    joints: list[int] = []
    while body:
        joints += range(int(m.body_jntadr[body]), int(m.body_jntadr[body]) + int(m.body_jntnum[body]))
        body = int(m.body_parentid[body])
    return joints


def _frames(
    m: mujoco.MjModel, demonstration: Demonstration, dofs: set[int], known: set[int]
) -> list[tuple[SensorFrame, bool, Channel]]:
    """Return the frames on bodies that these joints and known ones alone carry, whether turns are read, and what."""
    found: list[tuple[SensorFrame, bool, Channel]] = []
    for name, channel in demonstration.measured.items():
        row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, name)
        if row < 0 or int(m.sensor_type[row]) not in (PLACE, TURN) or (frame := sensor_frame(m, row)) is None:
            continue
        below = {int(m.jnt_dofadr[j]) for j in joints_below(m, frame.body)}
        if below & dofs and below <= dofs | known:
            found.append((frame, int(m.sensor_type[row]) == TURN, channel))
    return found


def _at(channel: Channel, time: np.ndarray, turn: bool, cfg: MarkedJointCfg) -> np.ndarray:
    """Return readings at other times, interpolated where those beside are near, shape (T, 3 or 4), else NaN."""
    found = np.full((len(time), channel.value.shape[1]), np.nan)
    columns = [slice(None)] if turn else [slice(k, k + 1) for k in range(channel.value.shape[1])]
    for column in columns:
        known = np.isfinite(channel.value[:, column]).all(axis=1)
        times, value = channel.time[known], np.array(channel.value[known][:, column], dtype=float)
        if len(times) < 2:
            continue
        if turn:
            value[1:] *= np.cumprod(np.where((value[1:] * value[:-1]).sum(axis=1) < 0, -1.0, 1.0))[:, None]
        after = np.clip(np.searchsorted(times, time - 1e-9), 0, len(times) - 1)
        before = np.clip(np.searchsorted(times, time + 1e-9, side="right") - 1, 0, len(times) - 1)
        near = times[after] - times[before] <= cfg.max_gap * np.median(np.diff(times))
        near &= (times[before] <= time + 1e-9) & (times[after] >= time - 1e-9)
        for k, one in enumerate(value.T):
            found[near, (column.start or 0) + k] = np.interp(time[near], times, one)
    return found


class _Solver:
    """Finds joints at one time after the other."""

    def __init__(
        self,
        m: mujoco.MjModel,
        marks: Sequence[_Mark],
        dofs: np.ndarray,
        known: KnownJoints,
        time: np.ndarray,
        cfg: MarkedJointCfg,
    ) -> None:
        """Take what was read at times (T,) [s]."""
        self._m, self._d, self._marks, self._dofs, self._cfg = m, mujoco.MjData(m), marks, dofs, cfg
        self._others, self._where = m.jnt_qposadr[m.dof_jntid[known.dof]], known.estimate(time)
        joints = m.dof_jntid[dofs]
        self._address = m.jnt_qposadr[joints]
        self._hinge = m.jnt_type[joints] == int(mujoco.mjtJoint.mjJNT_HINGE)

    def at(self, row: int, start: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the joints at a time, NaN where they are not determined, and from where the next time starts."""
        if not np.isfinite(self._where[row]).all():
            return np.full(len(self._dofs), np.nan), start
        self._d.qpos[self._others] = self._where[row]
        if start is None:
            value, error, determined = min((self._solved(row, one) for one in self._starts()), key=lambda one: one[1])
            turns = np.round((value - self._m.qpos0[self._address]) / (2 * math.pi))
            best = np.where(self._hinge, value - 2 * math.pi * turns, value), error, determined
        else:
            best = self._solved(row, start)
        value, error, determined = best
        if determined and error <= self._cfg.max_residual:
            return value, value
        return np.full(len(value), np.nan), start

    def _starts(self) -> list[np.ndarray]:
        """Return the starts at the first time."""
        options = [self._cfg.starts if hinge else (0.0,) for hinge in self._hinge]
        several = itertools.islice(itertools.product(*options), self._cfg.max_starts)
        return [self._m.qpos0[self._address] + np.array(one) for one in several]

    def _solved(self, row: int, start: np.ndarray) -> tuple[np.ndarray, float, bool]:
        """Return joints from a start, the root mean square of their residuals, and whether they are determined."""
        cfg, value = self._cfg, np.array(start, dtype=float)
        for _ in range(cfg.max_steps):
            residual, slope = self._residuals(row, value)
            if len(residual) < len(value):
                return value, np.inf, False
            step = np.clip(np.linalg.lstsq(slope, -residual, rcond=None)[0], -cfg.max_step, cfg.max_step)
            value = value + step
            if np.abs(step).max() < cfg.tolerance:
                break
        residual, slope = self._residuals(row, value)
        determined = np.linalg.svd(slope, compute_uv=False)[-1] > cfg.min_singular
        return value, float(np.sqrt(np.mean(residual**2))), bool(determined)

    def _residuals(self, row: int, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals of what was read at a time, shape (R,), and their derivatives, shape (R, U)."""
        m, d = self._m, self._d
        d.qpos[self._address] = value
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        residuals, slopes = [], []
        jacobian, spin = np.zeros((3, m.nv)), np.zeros((3, m.nv))
        for mark in self._marks:
            read, frame = mark.value[row], mark.frame
            known = np.isfinite(read)
            if not known.any():
                continue
            place = d.xpos[frame.body] + d.xmat[frame.body].reshape(3, 3) @ frame.offset
            mujoco.mj_jac(m, d, jacobian, spin, place, frame.body)
            if mark.turn:
                turn = Rotation.from_quat(d.xquat[frame.body], scalar_first=True) * frame.body_in_world(read).inv()
                residuals.append(turn.as_rotvec())
                slopes.append(spin[:, self._dofs].copy())
            else:
                back = frame.base_turn.inv()
                residuals.append((back.apply(place - frame.base_origin) - read)[known])
                slopes.append((back.as_matrix() @ jacobian[:, self._dofs])[known])
        if not residuals:
            return np.zeros(0), np.zeros((0, len(self._dofs)))
        return np.concatenate(residuals), np.concatenate(slopes)
