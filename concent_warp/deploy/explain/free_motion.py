"""The robot's motion before the manipulated object touches anything but the hand.

An error of perceived poses moves no joint there, so a discrepancy of the joints is one of the robot's physics.
"""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.deploy.explain.measured_start import HandFrame, MeasuredStart, joint_positions
from concent_warp.deploy.explain.replay_trial import TrialReadings
from concent_warp.recording.recording import Demonstration

MARGIN = 0.05
"""Distance beyond which bodies are far apart [m]."""


def free_readings(
    m: mujoco.MjModel,
    body: int,
    site: int,
    demonstration: Demonstration,
    readings: TrialReadings,
    start: MeasuredStart,
    clearance: float,
) -> int:
    """Return how many first joint readings of a trial are from before the object comes near other bodies.

    The object is carried along with the hand from its start, by the readings of the joints.

    Args:
        m: The compiled nominal scene.
        body: The manipulated object, free, at the same address as in the start.
        site: Site between the fingertips.
        demonstration: The trial.
        readings: Its readings.
        start: Its start.
        clearance: Distance from other bodies that counts as near [m].
    """
    address = int(m.jnt_qposadr[m.body_jntadr[body]])
    mine = [g for g in np.flatnonzero(m.geom_bodyid == body) if m.geom_contype[g] or m.geom_conaffinity[g]]
    others = [
        g
        for g in range(m.ngeom)
        if m.body_weldid[m.geom_bodyid[g]] == 0 and (m.geom_contype[g] or m.geom_conaffinity[g])
    ]
    places, turns = HandFrame(m, site, demonstration).at(readings.time)
    pose, back = start.qpos[address : address + 7], turns[0].inv()
    held = back.apply(pose[:3] - places[0])
    from scipy.spatial.transform import Rotation

    turned = back * Rotation.from_quat(pose[3:], scalar_first=True)
    data = mujoco.MjData(m)
    for row, qpos in enumerate(joint_positions(m, demonstration, readings.time)):
        data.qpos[:] = qpos
        data.qpos[address : address + 3] = places[row] + turns[row].apply(held)
        data.qpos[address + 3 : address + 7] = (turns[row] * turned).as_quat(scalar_first=True)
        mujoco.mj_kinematics(m, data)
        near = (mujoco.mj_geomDistance(m, data, a, b, MARGIN, None) for a in mine for b in others)
        if min(near, default=MARGIN) < clearance:
            return row
    return len(readings.time)
