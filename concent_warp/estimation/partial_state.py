"""The state of a scene at one time where only a part of it was measured.

Joints and free bodies are estimated from their own readings by local polynomials, positions of a body component by
component, and of joints of which the velocity alone was read, that; joints without a sensor follow from tendons,
equalities and poses of the bodies on them, as far as these determine them. What was not measured stands as the
recording's initial state or the model's reference pose has it, at rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.estimation.ball_signals import ball_signals
from concent_warp.estimation.joint_signals import (
    MIN_SINGULAR,
    CoupledJoints,
    determined_joints,
    joint_rates,
    joint_signals,
)
from concent_warp.estimation.local_polynomial import LocalPolynomialCfg
from concent_warp.estimation.object_tracks import frame_channel
from concent_warp.recording.recording import Channel
from concent_warp.simulate.replay import initial_state

if TYPE_CHECKING:
    from concent_warp.recording.recording import Demonstration


@dataclass(frozen=True)
class PartialState:
    """A state, and which part of it was measured."""

    qpos: np.ndarray
    """Shape (nq,) [m, rad]; quaternions wxyz of unit length."""
    qvel: np.ndarray
    """Shape (nv,) [m/s, rad/s]; 0 where it was not measured."""
    measured: np.ndarray
    """Of which degrees of freedom positions were measured, shape (nv,) bool."""


def told_joints(
    m: mujoco.MjModel, demonstration: Demonstration, cfg: LocalPolynomialCfg | None = None
) -> tuple[CoupledJoints, np.ndarray]:
    """Return the hinges and slides, and which of them nothing tells, shape (J,) bool, see `determined_joints`."""
    cfg = cfg or LocalPolynomialCfg()
    return determined_joints(m, demonstration, cfg, joint_signals(m, demonstration, cfg), MIN_SINGULAR)


def partial_state(
    m: mujoco.MjModel,
    demonstration: Demonstration,
    time: float,
    cfg: LocalPolynomialCfg | None = None,
    *,
    joints: tuple[CoupledJoints, np.ndarray] | None = None,
) -> PartialState:
    """Return the state at a time, as far as it was measured.

    Args:
        m: The compiled scene.
        demonstration: What was measured.
        time: Time [s].
        cfg: How readings are smoothed.
        joints: What `told_joints` found, where several times are asked for.
    """
    cfg, at = cfg or LocalPolynomialCfg(), np.array([time])
    qpos, qvel = initial_state(m, demonstration)
    measured = np.zeros(m.nv, dtype=bool)
    for joint in joint_signals(m, demonstration, cfg):
        found = joint.position.estimate(at)
        qpos[joint.qpos], qvel[joint.dof] = found.value[0, 0], found.rate[0, 0]
        measured[joint.dof] = True
    coupled, loose = told_joints(m, demonstration, cfg) if joints is None else joints
    if len(others := np.flatnonzero(~loose & ~measured[coupled.dof])):
        found = coupled.estimate(at)
        qpos[coupled.qpos[others]], qvel[coupled.dof[others]] = found.value[0, others], found.rate[0, others]
        measured[coupled.dof[others]] = True
    if demonstration.qvel is None or time > 0.0:
        for joint, rate in joint_rates(m, demonstration, cfg).items():
            qvel[m.jnt_dofadr[joint]] = rate.estimate(at).value[0, 0]
    for ball in ball_signals(m, demonstration, cfg):
        seen = ball.orientation.estimate(at)
        qpos[ball.qpos : ball.qpos + 4], qvel[ball.dof : ball.dof + 3] = seen.quaternion[0], seen.velocity[0]
        measured[ball.dof : ball.dof + 3] = True
    for joint in np.flatnonzero(m.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
        body = m.body(int(m.jnt_bodyid[joint])).name
        place, dof = int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])
        position = frame_channel(m, demonstration, body, mujoco.mjtSensor.mjSENS_FRAMEPOS)
        for k in range(3):
            signal = None if position is None else cfg.signal(Channel(position.time, position.value[:, [k]]))
            if signal is not None:
                found = signal.estimate(at)
                qpos[place + k], qvel[dof + k] = found.value[0, 0], found.rate[0, 0]
                measured[dof + k] = True
        turned = frame_channel(m, demonstration, body, mujoco.mjtSensor.mjSENS_FRAMEQUAT)
        orientation = None if turned is None else cfg.orientation(turned)
        if orientation is not None:
            seen = orientation.estimate(at)
            qpos[place + 3 : place + 7], qvel[dof + 3 : dof + 6] = seen.quaternion[0], seen.velocity[0]
            measured[dof + 3 : dof + 6] = True
    return PartialState(qpos, qvel, measured)
