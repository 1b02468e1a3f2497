"""Small worlds with a force that their models do not know of, in plain MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.recording.recording import Channel, Demonstration, Recording

PENDULUM = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.002"/>
      <geom type="capsule" fromto="0 0 0 .1 0 0" size=".01" mass=".03"/>
      <geom type="sphere" pos=".1 0 0" size=".02" mass=".1"/>
    </body>
  </worldbody>
  <actuator><position name="drive" joint="hinge" kp="1.5" kv="0.03"/></actuator>
  <sensor><jointpos name="angle" joint="hinge"/><jointvel name="rate" joint="hinge"/></sensor>
</mujoco>
"""
BLOCK = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <worldbody>
    <geom name="table" type="plane" size="2 2 .1" friction="0.3 .005 .0001" solref="0.006 1"/>
    <body name="block" pos="0 0 {height}">
      <freejoint/>
      <geom type="box" size=".045 .03 .02" mass=".25" friction="0.3 .005 .0001" solref="0.006 1"/>
    </body>
  </worldbody>
  <sensor>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""
COMMAND_PERIOD, READING_PERIOD = 0.01, 0.004


def swing(torque, *, seed=0, duration=5.0, noise=5e-4, rate=False):
    """Record a pendulum that follows a chirp; `torque(data)` acts on it besides its drive."""
    rng = np.random.default_rng(seed)
    m = mujoco.MjModel.from_xml_string(PENDULUM)
    d = mujoco.MjData(m)
    dt = m.opt.timestep
    commands, readings = [], []
    for k in range(round(duration / dt)):
        if k % round(COMMAND_PERIOD / dt) == 0:
            t = k * dt
            commands.append((t, 0.7 * np.sin(2 * np.pi * (0.3 + 0.1 * t) * t + seed)))
            d.ctrl[0] = commands[-1][1]
        if k % round(READING_PERIOD / dt) == 0:
            readings.append((k * dt, d.qpos[0], d.qvel[0]))
        d.qfrc_applied[0] = torque(d)
        mujoco.mj_step(m, d)
    time, angle, speed = np.array(readings).T
    measured = {"angle": Channel(time, (angle + rng.normal(0, noise, len(time)))[:, None], noise_std=noise)}
    if rate:
        measured["rate"] = Channel(time, (speed + rng.normal(0, 0.02, len(time)))[:, None], noise_std=0.02)
    action = {"drive": Channel(*np.array(commands).T)}
    return Recording(PENDULUM, (Demonstration("demo_0", qpos=np.zeros(1), action=action, measured=measured),))


def throw(
    force=(0, 0, 0),
    point=(0, 0, 0),
    *,
    fly=False,
    world=False,
    friction=0.3,
    speed=0.9,
    count=4,
    duration=0.6,
    seed=0,
    noise=(3e-4, 3e-3),
    rate=120,
):
    """Record throws of a block on a table, or high above it.

    A `force` [N] acts at a `point` of the block [m], both in its frame, or the force in the world's.
    """
    rng = np.random.default_rng(seed)
    xml = BLOCK.format(height=3.0 if fly else 0.02)
    m = mujoco.MjModel.from_xml_string(xml)
    m.geom_friction[:, 0] = friction
    dt = m.opt.timestep
    demonstrations = []
    for i in range(count):
        d = mujoco.MjData(m)
        yaw = rng.uniform(-1, 1)
        d.qpos[3:7] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
        if not fly:
            mujoco.mj_step(m, d, nstep=200)
        d.qvel[:] = (1, 0, 2, 3, 1, 2) if fly else (speed, 0, 0, 0, 0, 3)
        poses = []
        for k in range(round(duration / dt)):
            if k % round(1 / rate / dt) == 0:
                poses.append((k * dt, *d.qpos))
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, d.qpos[3:7])
            turn = turn.reshape(3, 3)
            push = np.array(force, float) if world else turn @ force
            d.xfrc_applied[1] = [*push, *np.cross(turn @ point, push)]
            mujoco.mj_step(m, d)
        time, pose = np.array(poses)[:, 0], np.array(poses)[:, 1:]
        for q in pose:
            mujoco.mju_quatIntegrate(quaternion := q[3:].copy(), rng.normal(0, noise[1], 3), 1.0)
            q[3:] = quaternion
        pose[:, :3] += rng.normal(0, noise[0], (len(pose), 3))
        measured = {
            "block_position": Channel(time, pose[:, :3], noise_std=noise[0]),
            "block_orientation": Channel(time, pose[:, 3:], noise_std=noise[1]),
        }
        demonstrations.append(Demonstration(f"demo_{i}", measured=measured))
    return Recording(xml, tuple(demonstrations))
