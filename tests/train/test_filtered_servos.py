"""Servos with a filter start an episode where their command holds them, not where the last episode left them."""

from types import SimpleNamespace
from typing import Any, cast

import mujoco
import numpy as np
import pytest
import torch

from concent_warp.train.environment.physics import MujocoPhysics, WarpPhysics
from concent_warp.train.resets.reset_states import ResetCandidate, ResetSampler

XML = """
<mujoco>
  <option timestep="0.005" gravity="0 0 0"/>
  <worldbody>
    <body name="slider"><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.02" mass="1"/></body>
  </worldbody>
  <actuator>
    <position name="slide" joint="slide" kp="500" dampratio="1" timeconst="0.1" ctrlrange="-0.25 0.5"/>
  </actuator>
</mujoco>
"""


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_a_reset_holds_the_joint_and_other_worlds_keep_their_state(engine):
    m = mujoco.MjModel.from_xml_string(XML)
    physics = (
        MujocoPhysics(m, 3, 10) if engine == "mujoco" else WarpPhysics(m, 3, 10, (), device="cpu", nconmax=8, njmax=16)
    )
    assert physics.memory["activation"].shape == (3, 1)
    physics.qpos[:] = torch.tensor([[0.4], [0.4], [-0.25]])
    physics.ctrl[:] = torch.tensor([[0.4], [0.4], [-0.3]])
    physics.reset_commands(torch.tensor([True, False, True]))
    physics.advance()
    reached = physics.qpos[:, 0].double().tolist()
    assert reached[0] == pytest.approx(0.4, abs=1e-6)
    assert reached[1] < 0.39
    assert reached[2] == pytest.approx(-0.25, abs=1e-6)
    for _ in range(60):
        physics.advance()
    assert physics.memory["activation"][:, 0].tolist() == pytest.approx([0.4, 0.4, -0.25], abs=1e-3)
    assert physics.qpos[:, 0].tolist() == pytest.approx([0.4, 0.4, -0.25], abs=1e-3)


def test_initial_states_settle_with_the_filter_at_their_command():
    m = mujoco.MjModel.from_xml_string(XML)
    sampler = cast(Any, SimpleNamespace(m=m, d=mujoco.MjData(m), cfg=SimpleNamespace(settling_time=0.1, slip=0.01)))
    sampler.monitored_position = lambda _: sampler.d.xpos[1].copy()
    candidate = ResetCandidate(0.0, 1, False, np.array([0.4]), np.array([0.4]), 0, np.zeros((0, 7)))
    settled = ResetSampler.settled_state(sampler, candidate)
    assert settled is not None
    assert settled[0] == pytest.approx(0.4, abs=1e-6)
