"""A pendulum with a servo, simulated with a known damping and measured with known noise."""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.fit.effects.observation import Window
from concent_warp.fit.effects.observe import observe
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

NOISE = 1e-3
"""Standard deviation of an angle [rad]."""
DAMPING = 0.02
"""What drawings of it lack [N m s/rad]."""
TIMESTEP = 0.005
"""Of the simulation [s]."""
PERIOD = 0.01
"""Time from one sample to the next [s]."""


def swing_scene(damping: float = 0.0, *, kp: float = 1.0, quaternion: bool = False, timestep: float = TIMESTEP) -> str:
    """Return the scene with some damping in the joint [N m s/rad]."""
    more = '<framequat name="turned" objtype="xbody" objname="arm"/>' if quaternion else ""
    return f"""
    <mujoco>
      <option timestep="{timestep}" integrator="implicitfast"/>
      <worldbody>
        <body name="arm" pos="0 0 1">
          <joint name="hinge" axis="0 1 0" damping="{damping}"/>
          <geom name="arm" type="capsule" fromto="0 0 0 0 0 -0.2" size="0.01" mass="0.3"/>
        </body>
      </worldbody>
      <actuator><position name="servo" joint="hinge" kp="{kp}" kv="{0.01 * kp}"/></actuator>
      <sensor><jointpos name="angle" joint="hinge"/>{more}</sensor>
    </mujoco>"""


def swung(
    damping: float = DAMPING,
    *,
    seconds: float = 2.0,
    seed: int = 0,
    told: float = 0.0,
    delay: float = 0.0,
    quaternion: bool = False,
    timestep: float = TIMESTEP,
) -> Recording:
    """Return a recording of one swing from 0.3 rad, commanded in steps.

    Args:
        damping: Of the true joint; the recording's scene has none.
        seconds: Length.
        seed: Of the noise.
        told: By how much the initial angle that the recording tells is off [rad].
        delay: From a command to the servo [s].
        quaternion: Whether the orientation of the arm is measured too.
        timestep: Of the simulation [s]; that of the recording's scene is `TIMESTEP`.
    """
    rng = np.random.default_rng(seed)
    m = mujoco.MjModel.from_xml_string(swing_scene(damping, quaternion=quaternion, timestep=timestep))
    d = mujoco.MjData(m)
    d.qpos[0] = 0.3
    steps = round(seconds / m.opt.timestep)
    at = np.arange(0.0, seconds, 0.25)
    command = np.array([0.8, -0.5, 0.3, -0.8, 0.6, 0.0, -0.3, 0.5] * (1 + len(at) // 8))[: len(at)]
    rows = []
    for k in range(steps + 1):
        given = max(k * m.opt.timestep - delay, 0.0)
        d.ctrl[0] = command[min(int(given / 0.25 + 1e-9), len(at) - 1)]
        mujoco.mj_forward(m, d)
        rows.append(d.sensordata.copy())
        mujoco.mj_step(m, d)
    rows = np.array(rows)[:: round(PERIOD / timestep)]
    time = PERIOD * np.arange(len(rows))
    measured = {"angle": Channel(time, rows[:, :1] + rng.normal(0, NOISE, (len(rows), 1)), NOISE)}
    if quaternion:
        turned = rows[:, 1:5].copy()
        for row in turned:
            mujoco.mju_quatIntegrate(row, rng.normal(0, NOISE, 3), 1.0)
        measured["turned"] = Channel(time, turned, NOISE)
    start = {"qpos": np.array([0.3 + told]), "qvel": np.zeros(1)}
    demonstration = Demonstration("demo_0", **start, action={"servo": Channel(at, command)}, measured=measured)
    return Recording(swing_scene(quaternion=quaternion), (demonstration,))


def drawing(recording: Recording) -> Model:
    """Return the model that a recording's own scene makes."""
    return Model(Scene(recording.scene))


def windows_of(recording: Recording, length: float | None = None) -> list[Window]:
    """Return the windows of a recording as its own scene sees them."""
    return observe(drawing(recording), recording, length=length)
