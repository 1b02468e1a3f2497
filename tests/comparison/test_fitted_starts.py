"""Where replays of demonstrations that do not state their initial state start."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.comparison.compare import compare_replays
from concent_warp.comparison.initial_states import FittedStartCfg, with_initial_states
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

NOISE = 1e-3
"""Standard deviation of a reading [m or rad]."""
SLIDE = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="sled">
      <joint name="rail" type="slide" axis="1 0 0" damping="{damping}"/><geom size="0.05" mass="1"/>
      <body name="arm">
        <joint name="hinge" axis="0 1 0" damping="0.02"/><geom size="0.03" pos="0 0 -0.3" mass="0.2"/>
      </body>
    </body>
  </worldbody>
  <sensor><jointpos name="place" joint="rail"/><framepos name="tip" objtype="body" objname="arm"/></sensor>
</mujoco>"""
LIMITED = FittedStartCfg()
FREE = FittedStartCfg(max_first_error=1e6)
PLACE, SPEED = 0.2, 0.8
"""Position [m] and velocity [m/s] of the sled at the start."""


def model(damping: float) -> Model:
    """Return a sled on a rail with some damping [N s/m]."""
    return Model(Scene(SLIDE.format(damping=damping)))


def recording(damping: float) -> Recording:
    """Return a run of the sled of which the position is read."""
    m = model(damping).compile()
    d, rng, rows = mujoco.MjData(m), np.random.default_rng(0), []
    d.qpos[0], d.qvel[0] = PLACE, SPEED
    for k in range(1500):
        mujoco.mj_forward(m, d)
        if k % 5 == 0:
            rows.append((d.time, d.qpos[0] + rng.normal(0, NOISE)))
        mujoco.mj_step(m, d)
    time, value = np.array(rows).T
    measured = {"place": Channel(time, value[:, None], noise_std=NOISE)}
    return Recording(SLIDE.format(damping=damping), (Demonstration("run", measured=measured),))


def start(of: Model, run: Recording, cfg: FittedStartCfg) -> tuple[np.ndarray, np.ndarray]:
    """Return the state in which the replay starts."""
    (d,) = with_initial_states(of, run, cfg=cfg).demonstrations
    assert d.qpos is not None
    assert d.qvel is not None
    return d.qpos, d.qvel


def first_error(of: Model, run: Recording, cfg: FittedStartCfg) -> float:
    """Return the RMS error of the first readings over their noise."""
    qpos, qvel = start(of, run, cfg)
    channel = run[0].measured["place"]
    first = channel.time <= channel.time[0] + cfg.first_readings
    predicted = qpos[0] + qvel[0] * channel.time[first]
    return float(np.sqrt(np.mean((channel.value[first, 0] - predicted) ** 2)) / NOISE)


def test_a_model_that_is_far_off_starts_where_the_first_readings_are():
    run, wrong = recording(2.0), model(0.2)
    assert first_error(wrong, run, FREE) > 20
    assert first_error(wrong, run, LIMITED) < 3
    found = compare_replays({"wrong": wrong}, run, "mujoco")
    assert found.worst_spans
    assert all(span.start > 0.02 for span in found.worst_spans)


def test_a_right_model_starts_where_all_readings_have_it():
    run = recording(2.0)
    limited, free = (np.concatenate(start(model(2.0), run, cfg)) for cfg in (LIMITED, FREE))
    np.testing.assert_array_equal(limited, free)
    assert limited[0] == pytest.approx(PLACE, abs=NOISE)
    assert limited[2] == pytest.approx(SPEED, abs=0.01)


def test_what_the_first_readings_do_not_show_stays_free():
    xml = SLIDE.format(damping=2.0)
    m = mujoco.MjModel.from_xml_string(xml)
    d, rng, rows = mujoco.MjData(m), np.random.default_rng(0), []
    d.qpos[1] = 0.3  # the swing of an arm that is not read moves the sled
    for k in range(1000):
        mujoco.mj_forward(m, d)
        if k % 5 == 0:
            rows.append((d.time, d.qpos[0] + rng.normal(0, NOISE / 10)))
        mujoco.mj_step(m, d)
    time, value = np.array(rows).T
    channel = Channel(time, value[:, None], noise_std=NOISE / 10)
    run = Recording(xml, (Demonstration("run", measured={"place": channel}),))
    for cfg in (LIMITED, replace(LIMITED, max_first_error=1e-6)):  # the latter tries all weights
        qpos, _ = start(Model(Scene(xml)), run, cfg)
        assert qpos[1] == pytest.approx(0.3, abs=0.03)


def test_first_readings_that_measured_states_miss_as_well_decide_nothing():
    run = recording(2.0)
    (d,) = run.demonstrations
    channel = d.measured["place"]
    value = channel.value.copy()
    value[:6:2] += 0.05  # no state shows these
    spoilt = replace(run, demonstrations=(replace(d, measured={"place": replace(channel, value=value)}),))
    qpos, _ = start(model(2.0), spoilt, LIMITED)
    assert qpos[0] == pytest.approx(PLACE, abs=5 * NOISE)


def test_errors_that_all_readings_share_are_no_errors_of_the_first_ones():
    run = recording(2.0)
    (d,) = run.demonstrations
    channel = d.measured["place"]
    n, shift = len(channel.time), 10 * NOISE
    shared = replace(channel, common=np.full((n, 1, 1), shift))
    run = replace(run, demonstrations=(replace(d, measured={"place": shared}),))
    qpos, _ = start(model(0.2), run, replace(LIMITED, max_first_error=1e-6))  # all weights are tried
    assert qpos[0] == pytest.approx(PLACE, abs=3 * shift)
