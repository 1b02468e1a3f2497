"""A pusher, a block of spheres and a static wall of spheres on a plane."""

from __future__ import annotations

import numpy as np

from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

XML = """
<mujoco>
  <option timestep="0.005" integrator="{integrator}"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1" friction=".5"/>
    <body name="pusher" pos="-.06 .004 .02">
      <joint name="push" type="slide" axis="1 0 0"/>
      <geom name="pad" type="box" size=".01 .03 .01" mass=".2"/>
    </body>
    <body name="block" pos="0 0 .021">
      <freejoint/>
      <geom name="block_box" type="box" size=".02 .02 .02" mass=".08"/>
    </body>
    <body name="wall" pos=".07 0 .02" euler="0 0 20">
      <geom name="wall_box" type="box" size=".005 .03 .02"/>
    </body>
  </worldbody>
  <actuator><position name="push" joint="push" kp="200" kv="10"/></actuator>
  <sensor>
    <framepos name="position" objtype="body" objname="block"/>
    <framelinvel name="velocity" objtype="body" objname="block"/>
    <framelinacc name="acceleration" objtype="body" objname="block"/>
    <jointpos name="joint" joint="push"/>
    <actuatorfrc name="force" actuator="push"/>
  </sensor>
</mujoco>
"""
STEPS = 200


def grid(half: np.ndarray, counts: tuple[int, int, int]) -> np.ndarray:
    axes = [np.linspace(-h, h, n) if n > 1 else np.zeros(1) for h, n in zip(half, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def make_geometry() -> ContactGeometry:
    block, wall = grid(np.full(3, 0.015), (3, 3, 3)), grid(np.array([0, 0.025, 0.015]), (1, 4, 3))
    count = len(block) + len(wall)
    return ContactGeometry(
        bodies=("block", "wall"),
        body=np.repeat([0, 1], [len(block), len(wall)]),
        position=np.concatenate([block, wall]),
        radius=np.full(count, 0.005),
        mass=np.full(count, 0.08 / len(block)),
        friction=np.full(count, 0.6),
    )


def make_model(integrator: str = "implicitfast") -> Model:
    return Model(Scene(XML.format(integrator=integrator)), make_geometry())
