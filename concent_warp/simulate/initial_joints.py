"""Joints that no sensor of their own measured, at time 0: what couplings and other sensors say of them.

The second finger of a gripper follows the first by an equality, a linkage closes its loop, the width of a gripper is
the length of a tendon, and the pose of a drawer or of a door tells its joint. The residuals of all of these are brought
down by Gauss and Newton's steps of the unmeasured hinges and slides, of least norm: a joint that nothing tells about
stays where it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.checks import Count, Positive
from concent_warp.scene.sensor_frame import SensorFrame

S = mujoco.mjtSensor
LENGTHS = (int(S.mjSENS_TENDONPOS), int(S.mjSENS_ACTUATORPOS))
FRAMES = (int(S.mjSENS_FRAMEPOS), int(S.mjSENS_FRAMEQUAT))


@dataclass(frozen=True)
class InitialJointsCfg:
    """How unmeasured joints are solved for."""

    max_steps: Count = 20
    """Most steps [-]."""
    max_step: Positive = 0.5
    """Largest step of a joint [m or rad]: a linkage stays on the branch on which the scene has it."""
    tolerance: Positive = 1e-9
    """Step below which a solution has converged [m or rad]."""
    difference: Positive = 1e-6
    """Displacement by which derivatives are found [m or rad]."""
    min_singular: Positive = 1e-3
    """Smallest singular value of the derivatives, as a share of the largest, that determines joints [-]; the weight of
    equality constraints is left aside, so that they hide no short lever."""
    equality_weight: Positive = 100.0
    """Weight of equality constraints, which hold, over measurements, which have noise [-]."""


@dataclass(frozen=True)
class InitialReadings:
    """First readings of sensors that may tell joints of other names: values by sensor, as far as they are known."""

    length: list[tuple[int, float]] = field(default_factory=list)
    """Of tendons and actuators: row of the sensor, length [m or rad]."""
    place: list[tuple[SensorFrame, np.ndarray]] = field(default_factory=list)
    """Of frames on bodies: position in the frame of the sensor [m], shape (3,), NaN where missing."""
    turn: list[tuple[SensorFrame, np.ndarray]] = field(default_factory=list)
    """Of frames on bodies: quaternion wxyz."""


def with_unmeasured_joints(
    m: mujoco.MjModel,
    qpos: np.ndarray,
    measured: Sequence[int],
    readings: InitialReadings,
    cfg: InitialJointsCfg | None = None,
) -> np.ndarray:
    """Return positions in which unmeasured hinges and slides agree with couplings and readings, shape (nq,).

    Args:
        m: The compiled scene.
        qpos: Positions, shape (nq,), right but for unmeasured joints.
        measured: Joints that are right.
        readings: What else was measured.
        cfg: Settings.
    """
    cfg = cfg or InitialJointsCfg()
    scalar = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    joints = [j for j in range(m.njnt) if int(m.jnt_type[j]) in scalar and j not in set(measured)]
    if not joints or not (m.neq or readings.length or readings.place or readings.turn):
        return qpos
    residuals = _Residuals(m, readings, cfg)
    at = m.jnt_qposadr[joints]
    limited = np.array(m.jnt_limited[joints], dtype=bool)
    low = np.where(limited, m.jnt_range[joints, 0], -np.inf)
    high = np.where(limited, m.jnt_range[joints, 1], np.inf)
    found, now = np.array(qpos, dtype=float), residuals(qpos)
    least = cfg.min_singular / (cfg.equality_weight if m.neq else 1)
    for _ in range(cfg.max_steps):
        slope = np.zeros((len(now), len(joints)))
        for k, address in enumerate(at):
            moved = found.copy()
            moved[address] += cfg.difference
            slope[:, k] = (residuals(moved) - now) / cfg.difference
        step = np.linalg.lstsq(slope, -now, rcond=least)[0] if len(now) else np.zeros(len(joints))
        told = np.abs(slope).max(axis=0, initial=0.0) > cfg.min_singular
        step *= told
        if np.abs(step).max() < cfg.tolerance:
            break
        tried = found.copy()
        stepped = np.clip(found[at] + np.clip(step, -cfg.max_step, cfg.max_step), low, high)
        tried[at] = np.where(told, stepped, found[at])  # a reference pose may be outside a joint's range
        after = residuals(tried)
        if not after @ after < now @ now:
            break
        found, now = tried, after
    return found


class _Residuals:
    """Residuals of equality constraints and readings as a function of the positions."""

    def __init__(self, m: mujoco.MjModel, readings: InitialReadings, cfg: InitialJointsCfg) -> None:
        """Take what was measured."""
        self._m, self._d, self._readings, self._weight = m, mujoco.MjData(m), readings, cfg.equality_weight

    def __call__(self, qpos: np.ndarray) -> np.ndarray:
        """Return the residuals, shape (R,)."""
        m, d = self._m, self._d
        d.qpos[:] = qpos
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        mujoco.mj_tendon(m, d)
        mujoco.mj_transmission(m, d)
        mujoco.mj_makeConstraint(m, d)  # contacts were not looked for
        equal = d.efc_type[: d.nefc] == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        parts = [self._weight * d.efc_pos[: d.nefc][equal]]
        for row, length in self._readings.length:
            of_tendon = int(m.sensor_type[row]) == int(S.mjSENS_TENDONPOS)
            lengths = d.ten_length if of_tendon else d.actuator_length
            parts.append(np.array([lengths[m.sensor_objid[row]] - length]))
        for frame, value in self._readings.place:
            place = d.xpos[frame.body] + d.xmat[frame.body].reshape(3, 3) @ frame.offset
            parts.append(np.nan_to_num(frame.base_turn.inv().apply(place - frame.base_origin) - value))
        for frame, value in self._readings.turn:
            turn = Rotation.from_quat(d.xquat[frame.body], scalar_first=True)
            parts.append((frame.body_in_world(value).inv() * turn).as_rotvec())
        return np.concatenate(parts)
