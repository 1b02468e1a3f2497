"""A proposed motion as arrays over time: commands, joint positions and object poses."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.diagnosis.experiment.motions import ProposedMotion
from concent_warp.diagnosis.experiment.suggested import ObjectMotion, SuggestedMotion, TimeSeries
from concent_warp.effects.select import SINGLE, driven_joints, free_bodies, servo_gain
from concent_warp.model import Model
from concent_warp.recording.recording import Demonstration
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.replay import commands
from concent_warp.simulate.select import EngineName, make_engine


def motion_trajectory(model: Model, motion: ProposedMotion, engine: EngineName, rate: float) -> SuggestedMotion:
    """Return a motion as a model predicts it.

    Args:
        model: The model of the present set-up; the motion's changes of it are applied.
        motion: The motion.
        engine: Which engine simulates.
        rate: Sampling rate of joints and objects [Hz].
    """
    model = motion.change(model).with_payloads(motion.payloads)
    simulator = make_engine(engine, model)
    m, dt = simulator.compiled, simulator.timestep
    steps = max(round(motion.duration / dt), 1)
    demonstration = Demonstration(motion.name, qpos=motion.qpos, qvel=motion.qvel, action=motion.action)
    ctrl = commands(m, demonstration, steps)
    for added in model.effects:
        ctrl = added.effect.command(m, ctrl, added.array)
    stride = max(round(1 / (rate * dt)), 1)
    record = list(range(0, steps + 1, stride))
    start = Variants(1, qpos=motion.qpos[None], qvel=motion.qvel[None])
    rollout = simulator.run(start, ctrl, record=record, bodies=[]).numpy()
    time, qpos, qvel = dt * np.array(record), rollout.qpos[0], rollout.qvel[0]
    joints = {
        m.joint(j).name: TimeSeries(time, qpos[:, m.jnt_qposadr[j]], joint_unit(m, int(j)))
        for j in np.flatnonzero(np.isin(m.jnt_type, SINGLE))
    }
    objects = {
        m.body(b).name: _object_motion(m, b, time, qpos, qvel)
        for b in free_bodies(m)
        if m.body(b).name not in motion.away
    }
    sent = {name: TimeSeries(c.time, c.value.ravel(), command_unit(m, name)) for name, c in motion.action.items()}
    return SuggestedMotion(motion.duration, sent, joints, objects, motion.away, motion.payloads)


def _object_motion(m: mujoco.MjModel, body: int, time: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> ObjectMotion:
    """Return the motion of a free body from positions (T, nq) and velocities (T, nv)."""
    joint = int(m.body_jntadr[body])
    at, dof = int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])
    orientation = qpos[:, at + 3 : at + 7]
    spin = Rotation.from_quat(orientation, scalar_first=True).apply(qvel[:, dof + 3 : dof + 6])
    return ObjectMotion(time, qpos[:, at : at + 3], orientation, qvel[:, dof : dof + 3], spin)


def joint_unit(m: mujoco.MjModel, joint: int) -> str:
    """Return the unit of a joint's position."""
    return "m" if m.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_SLIDE) else "rad"


def command_unit(m: mujoco.MjModel, actuator: str) -> str:
    """Return the unit of an actuator's command: that of its joint for a position drive, else "-"."""
    row = m.actuator(actuator).id
    joints = driven_joints(m, row)
    return joint_unit(m, joints[0]) if servo_gain(m, row) > 0 and len(joints) else "-"
