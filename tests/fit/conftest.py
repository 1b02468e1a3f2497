"""A block that drops on a floor: the smallest recording that says something about contact geometry."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from concent_warp.model import Model
from concent_warp.recording.recording import Demonstration, PointTrack, Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

HALF = 0.02
RADIUS = 0.004
DROP = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="block" pos="0 0 0.03">
      <freejoint/>
      <geom name="block" type="box" size="0.02 0.02 0.02" mass="0.08"/>
    </body>
  </worldbody>
</mujoco>
"""


def corner_spheres(half: float) -> ContactGeometry:
    """Return spheres of RADIUS that fill the corners of a cube of half edge `half`."""
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * (half - RADIUS)
    n = len(corners)
    return ContactGeometry(
        ("block",), np.zeros(n, int), corners, np.full(n, RADIUS), np.full(n, 0.08 / n), np.full(n, 0.5)
    )


@pytest.fixture(scope="session")
def drop() -> Recording:
    """Points on an exact box that drops, 60 frames a second, one of them hidden now and then."""
    return dropped(Scene(DROP).model)


def dropped(m: mujoco.MjModel) -> Recording:
    """Return what is seen of a block that drops."""
    d = mujoco.MjData(m)
    local = np.random.default_rng(0).uniform(-HALF, HALF, (24, 3))
    times, points = [], []
    while d.time < 0.5:
        mujoco.mj_forward(m, d)
        if len(times) <= d.time * 60:
            times.append(d.time)
            points.append(d.body("block").xpos + local @ d.body("block").xmat.reshape(3, 3).T)
        mujoco.mj_step(m, d)
    value = np.array(points)
    visible = np.ones(value.shape[:2], dtype=bool)
    visible[5:9, 3] = False
    track = PointTrack(np.array(times), np.where(visible[:, :, None], value, np.nan), visible)
    demonstration = Demonstration("demo_0", qpos=m.qpos0.copy(), qvel=np.zeros(m.nv), points={"block": track})
    return Recording(DROP, (demonstration,))


@pytest.fixture(scope="session")
def swollen() -> Model:
    """A model of the block whose spheres stand out by 3 mm."""
    return Model(Scene(DROP), corner_spheres(HALF + 0.003))
