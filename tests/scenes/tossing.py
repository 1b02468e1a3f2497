"""Tosses of a cube of known size, simulated with exact boxes and measured with noise."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

EDGE = 0.06
PERIOD = 1 / 150
NOISE = 1e-4
"""Standard deviation of a measured position [m]; of an orientation the same over a distance of 0.1 m."""


def toss_scene(edge: float) -> str:
    """Return a scene with a cube that a fit takes to have the given edge [m]; its inertia does not depend on it."""
    return f"""
    <mujoco>
      <option timestep="0.002"/>
      <worldbody>
        <geom name="board" type="plane" size="1 1 0.1" friction="0.3" solref="0.005 1"/>
        <body name="cube" pos="0 0 0.2">
          <freejoint/>
          <inertial pos="0 0 0" mass="0.2" diaginertia="1.2e-4 1.2e-4 1.2e-4"/>
          <geom name="cube" type="box" size="{edge / 2} {edge / 2} {edge / 2}" friction="0.3" solref="0.005 1"/>
          <site name="imu" quat="0.7071068 0.7071068 0 0"/>
        </body>
      </worldbody>
      <sensor>
        <framepos name="position" objtype="xbody" objname="cube"/>
        <framequat name="orientation" objtype="xbody" objname="cube"/>
        <framelinvel name="velocity" objtype="xbody" objname="cube"/>
        <gyro name="gyro" site="imu"/>
      </sensor>
    </mujoco>"""


def toss(rng: np.random.Generator, name: str, *, noise: float = NOISE, duration: float = 0.5) -> Demonstration:
    """Simulate and measure one toss; velocities as well, without noise."""
    m = Scene(toss_scene(EDGE)).model
    d = mujoco.MjData(m)
    d.qpos[:] = [0, 0, rng.uniform(0.08, 0.12), *Rotation.random(rng=rng).as_quat(scalar_first=True)]
    d.qvel[:] = [*rng.uniform(-0.3, 0.3, 2), -0.5, *rng.uniform(-4, 4, 3)]
    qpos, qvel = d.qpos.copy(), d.qvel.copy()
    times, rows = [], []
    while d.time < duration:
        mujoco.mj_forward(m, d)
        if d.time >= len(times) * PERIOD - 1e-9:
            times.append(d.time)
            rows.append(d.sensordata.copy())
        mujoco.mj_step(m, d)
    time, value = np.array(times), np.array(rows)
    turn = Rotation.from_rotvec(noise / 0.1 * rng.standard_normal((len(time), 3)))
    orientation = Rotation.from_quat(value[:, 3:7], scalar_first=True) * turn
    measured = {
        "position": Channel(time, value[:, :3] + noise * rng.standard_normal((len(time), 3))),
        "orientation": Channel(time, orientation.as_quat(scalar_first=True)),
        "velocity": Channel(time, value[:, 7:10]),
        "gyro": Channel(time, value[:, 10:13]),
    }
    return Demonstration(name, qpos=qpos, qvel=qvel, measured=measured)


def tosses(count: int, seed: int = 0, *, noise: float = NOISE) -> Recording:
    """Return some tosses."""
    rng = np.random.default_rng(seed)
    return Recording(toss_scene(EDGE), tuple(toss(rng, f"demo_{k}", noise=noise) for k in range(count)))
