"""Arms whose weight nothing compensates: their servos hold them by commands ahead of the joints."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from small_insertion import SETTINGS, XML, make_demonstration

from concent_warp.model import Model
from concent_warp.recording.recording import Channel
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.train.cfg import ActionCfg
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.physics import MujocoPhysics
from concent_warp.train.resets.sample import sample_reset_states
from concent_warp.train.task.held_arm import holding_leads
from concent_warp.train.task.robot import Robot
from concent_warp.train.task.task import Task

ARM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body gravcomp="{compensated}">
      <joint name="lift" type="slide" axis="0 0 1" damping="20"/><geom size="0.05" mass="1"/>
      <body name="link" gravcomp="{compensated}">
        <joint name="turn" axis="0 1 0" damping="1" actuatorgravcomp="{by_actuator}" {spring}/>
        <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.02" mass="0.5"/>
        <site name="tcp" pos="0.4 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="turn" joint="turn" kp="60"/><position name="lift" joint="lift" kp="900"/>
  </actuator>
</mujoco>
"""
WEIGHT, KP = 9.81, 600.0


def arm(compensated: float = 0.0, by_actuator: str = "false", spring: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM.format(compensated=compensated, by_actuator=by_actuator, spring=spring))


@pytest.mark.parametrize(
    "m",
    [arm(), arm(0.6), arm(0.6, "true"), arm(spring='stiffness="5" springref="-30"')],
    ids=["nothing", "compensation", "compensation by actuators", "spring"],
)
def test_an_arm_stays_where_commands_that_hold_it_put_it(m):
    d, at = mujoco.MjData(m), np.array([0.1, -0.3])
    (leads,) = holding_leads(m, mujoco.MjData(m), np.array([0, 1]), at[None])
    assert np.abs(leads).max() > 1e-3
    d.qpos[:], d.ctrl[:] = at, at[[1, 0]] + leads
    for _ in range(500):
        mujoco.mj_step(m, d)
    np.testing.assert_allclose(d.qpos, at, atol=1e-9)


def test_commands_equal_the_joints_of_an_arm_whose_weight_is_compensated():
    m, cfg = arm(1.0), ActionCfg(gripper_actuators=())
    held = Robot.of(m, cfg).holding(m, np.array([[0.0, 0.5], [0.1, -1.0]]))
    assert held.hold.tolist() == [0.0, 0.0]
    assert held.lead.tolist() == [cfg.turn_lead, cfg.slide_lead]


def test_leads_reach_as_far_beyond_the_holding_commands_of_all_positions():
    m, cfg, bent = arm(), ActionCfg(gripper_actuators=()), 1.0
    held = Robot.of(m, cfg).holding(m, np.array([[0.0, 0.0], [0.0, bent]]))
    # A positive angle about y lowers the link's middle, 0.2 m from its joint.
    out, low = -0.5 * WEIGHT * 0.2 / 60, -0.5 * WEIGHT * 0.2 * np.cos(bent) / 60
    np.testing.assert_allclose(held.hold, [(out + low) / 2, 1.5 * WEIGHT / 900], rtol=1e-6)
    np.testing.assert_allclose(held.lead, [cfg.turn_lead + (low - out) / 2, cfg.slide_lead], rtol=1e-6)


def test_an_arm_without_compensation_rests_while_a_policy_does_nothing():
    weak = XML.replace(' gravcomp="1"', "").replace('joint="z" kp="3000"', f'joint="z" kp="{KP}"')
    scene = Scene(weak)
    model = Model(scene, ContactGeometryCfg(counts={"block": 80, "box": 200}, radius="auto").build(scene))
    sag = 0.6 * WEIGHT / KP
    shown = make_demonstration(model)
    z = shown.action["z"]
    higher = replace(shown, action={**shown.action, "z": Channel(z.time, z.value + sag)})
    task = Task.build(model, higher, SETTINGS)
    np.testing.assert_allclose(task.robot.hold, [0, 0, sag], atol=1e-6)
    assert sag > 0.6 * task.robot.lead[2]
    states = sample_reset_states(task, replace(SETTINGS.reset, states=8), 0, count=8)
    physics = MujocoPhysics(task.compiled, 8, SETTINGS.decimation)
    environment = Environment(task, replace(SETTINGS, worlds=8), physics, states)
    environment.start_from(range(8))
    leads = environment.layout.columns("command leads")
    payload = 0.08 * WEIGHT / KP / task.robot.lead[2]
    assert environment.observation[:, leads].abs().max() < 1.02 * payload
    before = physics.qpos[:, task.robot.qpos].clone()
    for _ in range(5):
        environment.step(torch.zeros(8, task.robot.actions))
        moved = (physics.qpos[:, task.robot.qpos] - before)[~environment.done]
        assert moved.abs().max() < 5e-4
    # Commands upwards lead as far beyond as they do where the weight is compensated.
    largest = 0.0
    for _ in range(8):
        environment.step(torch.tensor([[0.0, 0.0, 1.0, 0.0]]).expand(8, -1))
        ahead = physics.ctrl[:, task.robot.actuator[2]] - sag - environment._before[0][:, task.robot.qpos[2]]
        largest = max(largest, float(ahead.max()))
    assert 0.5 * task.robot.lead[2] < largest < task.robot.lead[2] + 1e-6
