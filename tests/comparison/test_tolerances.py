"""What ordinary errors of nominal values alone would leave, beside what a model leaves."""

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.comparison import tolerances
from concent_warp.comparison.compare import CompareCfg, compare, compare_replays
from concent_warp.comparison.residuals import residuals
from concent_warp.comparison.result import Comparison
from concent_warp.comparison.tolerances import ToleranceCfg, ToleranceRange, tolerance_sentences
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

LIFT = """
<mujoco><option timestep="0.005"/><worldbody>
  <body name="load">
    <joint name="lift" type="slide" axis="0 0 1" damping="{damping}"/><geom size="0.05" mass="{mass}"/>
  </body>
</worldbody>
<actuator><position name="servo" joint="lift" kp="400" kv="20"/></actuator>
<sensor><jointpos name="height" joint="lift"/></sensor></mujoco>"""
"""A load on a servo, which sags by 49 mm per kg."""
NOISE = 5e-5
TIME = np.arange(0, 3, 0.01)


def recorded(mass: float, damping: float = 0.0) -> Recording:
    """Return what a lift of some mass and damping [N s/m] reads on steps of its set-point, from its rest."""
    m = mujoco.MjModel.from_xml_string(LIFT.format(mass=mass, damping=damping))
    d = mujoco.MjData(m)
    start = m.opt.gravity[2] / 400
    d.qpos[0] = start
    command, read = np.where(TIME % 2 < 1, 0.0, 0.2), []
    for u in command:
        read.append(d.qpos[0])
        d.ctrl[0] = u
        mujoco.mj_step(m, d, 2)
    seen = np.array(read) + np.random.default_rng(0).normal(0, NOISE, len(read))
    demonstration = Demonstration(
        "demo_0",
        qpos=np.array([start]),
        qvel=np.zeros(1),
        action={"servo": Channel(TIME, command)},
        measured={"height": Channel(TIME, seen[:, None], NOISE)},
    )
    return Recording(LIFT.format(mass=1.0, damping=0.0), (demonstration,))


def compared(recording: Recording, **settings: float) -> Comparison:
    cfg = CompareCfg(phases="none", tolerances=replace(ToleranceCfg(), **settings))
    return compare(Model(Scene(recording.scene)), recording, cfg)


def left(found: Comparison) -> float:
    """Return the RMS error of the height over its noise."""
    ratio = found.summarise("model", "height").ratio
    assert ratio is not None
    return ratio


def test_what_a_mass_off_by_its_tolerance_leaves_is_no_more_than_tolerances_do():
    found = compared(recorded(1.01))
    assert left(found) > 3
    said = " ".join(found.tolerance_sentences())
    assert "height" in said
    assert "may be no more" in said


def test_damping_that_is_missing_leaves_more():
    found = compared(recorded(1.0, damping=10.0))
    ratio = left(found)
    assert ratio > found.tolerances["height"].high > found.tolerances["height"].low >= 1
    assert f"more than that in height ({ratio:.0f} x)" in " ".join(found.tolerance_sentences())


def test_the_range_is_that_of_errors_of_mass_gain_and_clock():
    # At most two standard deviations of mass and gain: 4 % of a sag of 24.5 mm at rest is 19.6 x noise; on the way by
    # 0.2 m, gains alone, which set its speed, move it by no more than 2 % of that for a tenth of the time.
    found = compared(recorded(1.1), draws=100)
    assert 10 < found.tolerances["height"].high < 35
    assert 1 <= found.tolerances["height"].low < 4


@pytest.mark.parametrize("settings", [{"draws": 0}, {"draws": 1}, {"min_ratio": 1e4}, {"max_steps": 1100}])
def test_it_is_not_asked_where_settings_say_so(settings):
    found = compared(recorded(1.01), **settings)
    assert not found.tolerances
    assert not found.tolerance_sentences()


def test_with_fewer_steps_there_are_fewer_draws():
    # A replay has 598 steps.
    assert compared(recorded(1.01), max_steps=1300).tolerances == compared(recorded(1.01), draws=2).tolerances


def test_a_model_that_leaves_noise_is_not_asked():
    assert not compared(recorded(1.0)).tolerances


def test_ranges_are_in_json_and_in_notebooks():
    found = compared(recorded(1.01))
    known = found.tolerances["height"]
    assert found.to_json()["tolerances"] == {"height": {"low": known.low, "high": known.high}}
    assert found.tolerance_sentences()[1] in found._repr_html_()
    lost = replace(found, tolerances={"height": ToleranceRange(1.0, np.inf)})
    assert json.loads(json.dumps(lost.to_json(), allow_nan=False))["tolerances"]["height"]["high"] is None


def test_a_replay_that_diverges_counts_as_far_off_and_what_was_never_measured_not_at_all(monkeypatch):
    recording = recorded(1.01)
    (d,) = recording.demonstrations
    height = d.measured["height"]
    unseen = replace(height, value=np.full_like(height.value, np.nan))
    partly = replace(recording, demonstrations=(d, replace(d, name="demo_1", measured={"height": unseen})))
    found = compare_replays({"model": Model(Scene(recording.scene))}, partly, phases={}, tolerance_cfg=ToleranceCfg())
    assert np.isfinite(found.tolerances["height"].high)

    def lost(*arguments):
        (found,) = residuals(*arguments)
        error = found.error.copy()
        error[-3:] = np.inf
        value = found.value.copy()
        value[-3:] = np.nan
        return (replace(found, error=error, value=value),)

    monkeypatch.setattr(tolerances, "residuals", lost)
    found = compared(recording)
    assert found.tolerances["height"] == ToleranceRange(np.inf, np.inf)
    assert "leave: height over 1000 x noise" in found.tolerance_sentences()[0]


def test_three_channels_are_named_those_that_leave_most_first():
    ranges = {name: ToleranceRange(1.0, 2.0) for name in ("a", "b", "c_d", "e", "f")}
    first, second = tolerance_sentences(ranges, {"a": 3.0, "b": 12.0, "c_d": 5.0, "e": 4.0})
    assert first.endswith("would alone leave: b 1.0 to 2.0 x noise, c d 1.0 to 2.0 x noise, e 1.0 to 2.0 x noise.")
    assert second == "The model leaves more than that in b (12 x), c d (5.0 x), e (4.0 x) and 1 more."
    assert tolerance_sentences({}, {"a": 3.0}) == []
