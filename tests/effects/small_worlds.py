"""Tiny scenes with known physics, and their motion in C MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from concent_warp.effects.effect import Effect
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine

G = 9.81

SLIDER = """
<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody><body name="cart">
  <joint name="rail" type="slide" axis="1 0 0" {joint}/>
  <geom type="sphere" size="0.05" mass="2" contype="0" conaffinity="0"/>
</body></worldbody><actuator>{actuator}</actuator>
<sensor><jointpos name="encoder" joint="rail"/></sensor></mujoco>"""
"""A cart of 2 kg on a rail, without gravity; joint attributes and the actuator are to be filled in."""

MOTOR = '<motor name="drive" joint="rail"/>'

PENDULUM = """
<mujoco><option timestep="0.001"/><worldbody><body name="link">
  <joint name="hinge" type="hinge" axis="0 1 0"/>
  <inertial pos="0 0 -0.2" mass="0.5" diaginertia="0.004 0.004 0.004"/>
  <geom type="sphere" size="0.02" pos="0 0 -0.2" mass="0" contype="0" conaffinity="0"/>
</body></worldbody><actuator><motor name="drive" joint="hinge"/></actuator>
<sensor><jointpos name="encoder" joint="hinge"/></sensor></mujoco>"""
"""0.5 kg, 0.2 m below the hinge, inertia 0.004 kg m^2 about the centre of mass."""

FLOOR = """
<mujoco><option timestep="0.001" cone="elliptic" impratio="10"/><worldbody>
  <geom name="floor" type="plane" size="5 5 0.1" friction="0.3" {floor}/>
  <body name="thing" pos="0 0 {height}"><freejoint/>
    <geom name="thing" type="{type}" size="{size}" mass="0.4" friction="0.3" {geom}/></body>
</worldbody><sensor><framepos name="position" objtype="body" objname="thing"/>
<framequat name="orientation" objtype="body" objname="thing"/></sensor></mujoco>"""
"""A body of 0.4 kg on a floor, friction 0.3."""

BLOCK = FLOOR.format(type="box", size="0.05 0.04 0.02", height=0.02, floor="", geom="")
BALL = FLOOR.format(type="sphere", size="0.05", height=0.05, floor="", geom="")

GRIPPER = """
<mujoco><option timestep="0.001" cone="elliptic" impratio="10" iterations="50" ls_iterations="50"/><worldbody>
  <body name="hand" pos="0 0 0.1"><joint name="lift" type="slide" axis="0 0 1" damping="5"/>
    <geom type="box" size="0.03 0.03 0.01" mass="0.3" contype="0" conaffinity="0"/>
    <body name="left" pos="0 0.025 -0.06"><joint name="left" type="slide" axis="0 -1 0"/>
      <geom name="left" type="box" size="0.01 0.005 0.02" mass="0.05" friction="0.5"/></body>
    <body name="right" pos="0 -0.025 -0.06"><joint name="right" type="slide" axis="0 1 0"/>
      <geom name="right" type="box" size="0.01 0.005 0.02" mass="0.05" friction="0.5"/></body></body>
  <body name="block" pos="0 0 0.04"><freejoint/>
    <geom name="block" type="box" size="0.02 0.02 0.02" mass="0.1" friction="0.5"/></body>
</worldbody><actuator><position name="lift" joint="lift" kp="2000" kv="50"/>
  <motor name="left" joint="left"/><motor name="right" joint="right"/></actuator>
<sensor><framepos name="block" objtype="body" objname="block"/><jointpos name="height" joint="lift"/></sensor>
</mujoco>"""
"""Two fingers with pads of friction 0.5 that push on a block of 0.1 kg in the air with the commanded forces."""


@dataclass(frozen=True)
class Motion:
    """What one world did; K steps."""

    time: np.ndarray
    """[s], shape (K + 1,)."""
    qpos: np.ndarray
    """Shape (K + 1, nq)."""
    qvel: np.ndarray
    """Shape (K + 1, nv)."""
    sensor: Mapping[str, np.ndarray]
    """What was there to see, shape (K + 1, dim) each."""

    def read(self, sensor: str, time: np.ndarray) -> np.ndarray:
        """Return a sensor at some times, shape (T, dim)."""
        value = self.sensor[sensor]
        return np.stack([np.interp(time, self.time, value[:, i]) for i in range(value.shape[1])], axis=1)


def world(xml: str, effect: Effect | None = None, *values: float) -> Model:
    """Return a model of an MJCF, with an effect if there is one."""
    model = Model(Scene(xml))
    return model if effect is None else model.add(effect, values)


def move(
    model: Model,
    seconds: float,
    *,
    ctrl: np.ndarray | Sequence[float] | float = 0.0,
    qpos: Sequence[float] | None = None,
    qvel: Sequence[float] | None = None,
) -> Motion:
    """Simulate; `ctrl`, shape (K, nu) or what broadcasts to it, is changed by the model's effects first."""
    engine = MujocoEngine(model, threads=1)
    m = engine.compiled
    steps = round(seconds / m.opt.timestep)
    given = np.array(np.broadcast_to(ctrl, (steps, m.nu)), dtype=float)
    for added in model.effects:
        given = added.effect.command(m, given, added.array)
    start, speed = (None if v is None else np.array([v], dtype=float) for v in (qpos, qvel))
    rollout = engine.run(Variants(1, qpos=start, qvel=speed), given)
    assert not rollout.diverged.any()
    sensor = {
        m.sensor(i).name: rollout.sensordata[0][:, m.sensor_adr[i] : m.sensor_adr[i] + m.sensor_dim[i]]
        for i in range(m.nsensor)
    }
    return Motion(rollout.time, rollout.qpos[0], rollout.qvel[0], sensor)
