"""States of which only a part was measured."""

from dataclasses import replace

import numpy as np
import pytest

from concent_warp.comparison.initial_states import with_initial_states
from concent_warp.estimation.partial_state import partial_state
from concent_warp.fit.effects.observation import ObservationCfg, start_spread
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

DRUM = """<mujoco><worldbody><body><joint name="drum" axis="0 0 1"/><geom size="0.1" mass="1"/></body></worldbody>
<sensor><jointvel name="tacho" joint="drum"/><jointpos name="encoder" joint="drum"/></sensor></mujoco>"""


def test_a_joint_of_which_the_velocity_alone_was_read_starts_with_it():
    time, m, cfg = np.arange(0, 1, 0.01), Scene(DRUM).model, ObservationCfg()
    d = Demonstration("demo_0", measured={"tacho": Channel(time, 12.0 + 0.0 * time[:, None], noise_std=0.05)})
    found = partial_state(m, d, 0.0)
    assert found.qvel == pytest.approx([12.0])
    assert not found.measured.any()
    assert partial_state(m, replace(d, qvel=np.array([5.0])), 0.0).qvel == pytest.approx([5.0])
    spread = start_spread(m, {"tacho": 0.05}, measured=found.measured)
    np.testing.assert_allclose(spread, [cfg.unmeasured_position, cfg.state_noise * 0.05])
    both = start_spread(m, {"tacho": 0.05, "encoder": 0.01}, measured=np.ones(1, bool))
    assert both[1] == cfg.state_noise * 0.01 / cfg.velocity_time
    start = with_initial_states(Model(Scene(DRUM)), Recording(DRUM, (d,)))[0].qvel
    assert start == pytest.approx([12.0], rel=1e-3)
