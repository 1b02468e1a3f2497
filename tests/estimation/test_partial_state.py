"""States of which only a part was measured."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.comparison.initial_states import with_initial_states
from concent_warp.estimation.partial_state import partial_state
from concent_warp.fit.effects.observation import ObservedRecording, start_spread
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.fit.effects.observe import _calmest, observe
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


PUSHED = """<mujoco><option timestep="0.002"/><worldbody>
<geom type="plane" size="1 1 0.1"/>
<body name="finger" pos="-0.08 0 0.02"><joint name="x" type="slide" axis="1 0 0" damping="5"/>
  <geom size="0.01" mass="0.5"/></body>
<body name="thing" pos="0 0 0.02"><freejoint/><geom type="box" size="0.03 0.04 0.02" mass="0.4"/></body>
</worldbody><actuator><position name="x" joint="x" kp="800" kv="40"/></actuator>
<sensor><jointpos name="x" joint="x"/><framepos name="place" objtype="xbody" objname="thing"/>
<framequat name="turned" objtype="xbody" objname="thing"/></sensor></mujoco>"""


@pytest.fixture(scope="module")
def pushed():
    """A box that a finger pushes, seen from above: its height is not measured; with the true states."""
    m = Scene(PUSHED).model
    d, rows, time = mujoco.MjData(m), [], 0.02 * np.arange(115)
    command = np.interp(time, [0.2, 1.5], [0.0, 0.16])
    for u in command:
        d.ctrl[0] = u
        mujoco.mj_forward(m, d)
        rows.append(np.concatenate([d.qpos, d.qvel, d.sensordata]))
        mujoco.mj_step(m, d, 10)
    rows = np.array(rows)
    read = rows[:, m.nq + m.nv :] + np.random.default_rng(0).normal(0, 2e-4, (len(time), m.nsensordata))
    place = read[:, 1:4].copy()
    place[:, 2] = np.nan
    measured = {"x": Channel(time, read[:, :1], 2e-4), "place": Channel(time, place, 2e-4),
                "turned": Channel(time, read[:, 4:8], 2e-4)}  # fmt: skip
    seen = Demonstration("demo_0", action={"x": Channel(time, command[:, None])}, measured=measured)
    return Recording(PUSHED, (seen,)), time, rows[:, : m.nq], rows[:, m.nq : m.nq + m.nv]


def test_windows_begin_where_a_coordinate_of_an_object_was_not_measured(pushed):
    recording, time, qpos, qvel = pushed
    windows = observe(Model(Scene(PUSHED)), recording, cfg=ObservationCfg(scatter_samples=0))
    assert len(windows) > 1
    cfg = ObservationCfg()
    for w in windows[1:]:
        row = round(w.start / 0.02)
        assert abs(w.qpos[3] - qpos[row, 3]) < 2e-4  # the height, which a camera above does not see
        assert abs(w.qvel[3] - qvel[row, 3]) < 2 * w.spread[10]  # it hops as it slides
        np.testing.assert_allclose(w.qpos[:3], [np.interp(w.start, time, x) for x in qpos[:, :3].T], atol=1e-3)
        assert w.spread[3] == pytest.approx(cfg.state_noise * cfg.unmeasured_position)
    assert windows[0].spread[3] == cfg.unknown_position


def test_a_motion_of_which_nothing_tells_where_a_body_is_stays_whole(pushed):
    recording, *_ = pushed
    blind = replace(recording[0], measured={"x": recording[0].measured["x"]})
    source = ObservedRecording(Model(Scene(PUSHED)), Recording(PUSHED, (blind,)), {"x": 2e-4})
    assert source.guided(blind) is None
    assert len(observe(Model(Scene(PUSHED)), Recording(PUSHED, (blind,)))) == 1


def test_a_window_lasts_until_replays_tell_what_was_not_measured(pushed):
    recording, *_ = pushed
    source = ObservedRecording(Model(Scene(PUSHED)), recording, {"x": 2e-4, "place": 2e-4, "turned": 2e-4})
    guided, cfg = source.guided(recording[0]), ObservationCfg()
    assert guided is not None
    late = replace(guided, known=guided.time > 1.2)
    assert 1.2 < _calmest(late, 0.0, 0.3, cfg) < 1.5
    assert 1.2 < _calmest(late, 1.0, 0.5, cfg) <= 1.5
    assert _calmest(replace(guided, known=guided.time < 0.0), 0.0, 0.3, cfg) == np.inf


def test_replays_that_are_set_to_readings_forget_an_unknown_start(pushed):
    recording, _, qpos, _ = pushed
    source = ObservedRecording(Model(Scene(PUSHED)), recording, {"x": 2e-4, "place": 2e-4, "turned": 2e-4})
    guided = source.guided(recording[0])
    assert guided is not None
    assert guided.is_known(np.array([0.0, 0.05, 1.5, 2.0])).tolist() == [False, False, True, True]
    state = guided.state(1.5)
    assert state.measured.tolist() == [True, True, True, False, True, True, True]
    assert state.qpos[3] == pytest.approx(qpos[75, 3], abs=2e-4)
    assert np.linalg.norm(state.qpos[4:8]) == pytest.approx(1.0)
