"""A servo of Dynamixel's size swings a payload on a 0.1 m arm; it hangs at angle 0. Encoder and tracker measure it."""

from __future__ import annotations

import numpy as np

from concent_warp.reality.rigs.rig import Rig, RigTrial, of_coarser_step
from concent_warp.reality.rigs.signals import chirp, hold, joined, minimum_jerk_profile, sweep
from concent_warp.scene.scene import Scene

DURATION = 10.0
XML = """
<mujoco model="pendulum">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <light pos="0.3 -0.5 1"/>
    <geom name="stand" type="box" pos="0 0.05 0.3" size="0.02 0.015 0.02" contype="0" conaffinity="0"/>
    <body name="arm" pos="0 0 0.3">
      <joint name="hinge" axis="0 1 0"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.1" size="0.008" mass="0.03" contype="0" conaffinity="0"/>
      <geom name="weight" type="cylinder" pos="0 0 -0.1" size="0.022 0.01" euler="1.5707963 0 0" mass="0.3"
            contype="0" conaffinity="0"/>
      <site name="marker" pos="0 0 -0.1" size="0.004"/>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="hinge" kp="5" kv="0.1" forcerange="-1.2 1.2"/>
  </actuator>
  <sensor>
    <jointpos name="hinge_position" joint="hinge"/>
    <framepos name="marker_position" objtype="site" objname="marker"/>
  </sensor>
</mujoco>
"""


def _plan(rng: np.random.Generator, k: int) -> RigTrial:
    """Sweep at four speeds, swing with rising frequency, reverse slowly, hold at two heights."""
    del k
    reach = rng.uniform(1.1, 1.4)
    sign = rng.choice([-1.0, 1.0])
    a, b = sign * reach, -sign * rng.uniform(0.9, 1.2)
    speeds = rng.permutation([1.0, 2.0, 4.0]) * rng.uniform(0.85, 1.15, 3)
    centre = rng.uniform(0.3, 0.7) * sign
    slow = rng.uniform(0.12, 0.2)
    parts = [hold(0.0, 0.3), sweep(0.0, a, speeds[0])]
    parts += [sweep(a, b, speeds[1]), sweep(b, a, speeds[2]), hold(a, 0.4)]
    parts += [minimum_jerk_profile(a, centre, 0.6), chirp(centre, rng.uniform(0.2, 0.3), 0.5, 5.0, 2.5)]
    parts += [sweep(centre, centre - 0.15, slow), sweep(centre - 0.15, centre, slow)]
    parts += [sweep(centre, b, 0.8), hold(b, 0.4), minimum_jerk_profile(b, 0.0, 0.5)]
    parts += [hold(0.0, max(0.1, DURATION - sum(map(len, parts)) / 100))]
    return RigTrial(DURATION, {"servo": joined(parts)}, settling_time=0.5)


SCENE = Scene(XML, "pendulum rig")
PENDULUM = Rig("pendulum", SCENE, _plan, of_coarser_step(SCENE), body="arm")
