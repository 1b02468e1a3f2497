"""Measured motion of ball joints: by their own sensors, or by the orientation of the bodies that turn on them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.estimation.body_signals import velocity_channels
from concent_warp.estimation.local_polynomial import LocalPolynomialCfg
from concent_warp.estimation.marked_joints import joints_below
from concent_warp.estimation.object_tracks import frame_channel
from concent_warp.estimation.signals import MeasuredBall
from concent_warp.estimation.smoothing_spline import SmoothingSplineCfg
from concent_warp.recording.recording import Channel

if TYPE_CHECKING:
    from concent_warp.recording.recording import Demonstration

SENSOR = mujoco.mjtSensor
BALL, SLIDE = int(mujoco.mjtJoint.mjJNT_BALL), int(mujoco.mjtJoint.mjJNT_SLIDE)


def ball_signals(
    m: mujoco.MjModel, demonstration: Demonstration, smoother: LocalPolynomialCfg | SmoothingSplineCfg
) -> tuple[MeasuredBall, ...]:
    """Return the ball joints whose rotation was measured.

    Args:
        m: The compiled scene.
        demonstration: What was measured.
        smoother: How readings are smoothed.
    """
    found = []
    for joint in np.flatnonzero(m.jnt_type == BALL):
        turned, spin = _channels(m, demonstration, int(joint))
        if turned is None:
            continue
        if isinstance(smoother, LocalPolynomialCfg):
            signal = smoother.orientation(turned, spin)
        else:
            signal = smoother.orientation(turned, Rotation.identity())
        if signal is not None:
            addresses = int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])
            found.append(MeasuredBall(m.joint(joint).name or f"joint{joint}", *addresses, signal))
    return tuple(found)


def _channels(m: mujoco.MjModel, demonstration: Demonstration, joint: int) -> tuple[Channel | None, Channel | None]:
    """Return the measured rotation of a ball joint, quaternions wxyz, and its angular velocity [rad/s], if any."""
    own = {}
    for name, channel in demonstration.measured.items():
        row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SENSOR, name)
        if row >= 0 and int(m.sensor_objid[row]) == joint:
            own[int(m.sensor_type[row])] = channel
    turned, spin = own.get(int(SENSOR.mjSENS_BALLQUAT)), own.get(int(SENSOR.mjSENS_BALLANGVEL))
    body = int(m.jnt_bodyid[joint])
    if any(int(m.jnt_type[j]) != SLIDE for j in joints_below(m, body) if j != joint):
        return turned, spin  # the body turns on other joints, too
    name = m.body(body).name
    if turned is None:
        turned = frame_channel(m, demonstration, name, SENSOR.mjSENS_FRAMEQUAT)
        turned = None if turned is None else _from_rest(m, body, turned)
    return turned, spin or velocity_channels(m, demonstration, name)[1]


def _from_rest(m: mujoco.MjModel, body: int, turned: Channel) -> Channel:
    """Return measured orientations of a body in the world as rotations from that in the reference pose."""
    d = mujoco.MjData(m)
    mujoco.mj_kinematics(m, d)
    rest = Rotation.from_quat(d.xquat[body], scalar_first=True)
    valid, value = np.isfinite(turned.value).all(axis=1), np.full(turned.value.shape, np.nan)
    if valid.any():
        seen = Rotation.from_quat(turned.value[valid], scalar_first=True)
        value[valid] = (rest.inv() * seen).as_quat(scalar_first=True)
    return replace(turned, value=value)
