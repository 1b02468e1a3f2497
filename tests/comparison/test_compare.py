import json
from dataclasses import replace
from html import escape
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from concent_warp.comparison.compare import compare_replays
from concent_warp.comparison.result import Phase
from concent_warp.comparison.table import markdown_table, rich_table
from concent_warp.comparison.tolerances import ToleranceCfg
from concent_warp.comparison.units import ratio_text, value_text
from concent_warp.effects.library.drives import ActuatorDelay
from concent_warp.effects.library.measurement import Latency
from concent_warp.errors import ModelError, RecordingError
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.replay import replay

XML = """
<mujoco>
  <option timestep="0.005" integrator="{integrator}"/>
  <worldbody>
    <body name="cart">
      <joint name="rail" type="slide" axis="1 0 0" damping="{damping}"/><geom size=".1" mass="1"/>
    </body>
  </worldbody>
  <actuator><position name="drive" joint="rail" kp="40" dampratio="0.5"/></actuator>
  <sensor>
    <jointpos name="rail" joint="rail"/><framepos name="cart" objtype="xbody" objname="cart"/>
  </sensor>
</mujoco>
"""
TIME = np.arange(0, 2, 0.01)
STAGES = (Phase("pick", 0.5, 1.0), Phase("push", 1.0, 2.0))


def model(damping, integrator="implicitfast"):
    return Model(Scene(XML.format(damping=damping, integrator=integrator)))


def recorded(truth, names=("demo_0",), noise=1e-4):
    """What a cart with the physics of `truth` does on a square-wave command."""
    import mujoco

    rng = np.random.default_rng(0)
    demonstrations = []
    for k, name in enumerate(names):
        m = truth.compile()
        d = mujoco.MjData(m)
        command = 0.1 * (1 + k) * np.sign(np.sin(2 * np.pi * TIME))
        position = np.zeros(len(TIME))
        for i in range(len(TIME)):
            d.ctrl[0] = command[i]
            position[i] = d.qpos[0]
            mujoco.mj_step(m, d, nstep=2)
        readings = {
            "rail": Channel(TIME, (position + rng.normal(0, noise, len(TIME)))[:, None], noise_std=noise),
            "cart": Channel(TIME, np.stack([position, 0 * position, 0 * position], axis=1)),
        }
        action = {"drive": Channel(TIME, command)}
        demonstrations.append(Demonstration(name, qpos=np.zeros(1), qvel=np.zeros(1), action=action, measured=readings))
    return Recording(truth.scene.xml, tuple(demonstrations))


@pytest.fixture(scope="module")
def comparison():
    truth = model(2)
    recording = recorded(truth, ("demo_0", "demo_1"))
    return compare_replays(
        {"wrong": model(6), "right": truth}, recording, "mujoco", phases={"demo_0": STAGES, "demo_1": STAGES}
    )


def test_the_true_model_is_off_by_no_more_than_the_noise(comparison):
    summary = comparison.summarise("right", "rail")
    assert summary.rms == pytest.approx(summary.noise, rel=0.15)
    assert summary.low < summary.mean < summary.high
    assert summary.count == 2 * len(TIME)
    assert comparison.summarise("right", "cart").max < 1e-9


def test_statistics_are_those_of_the_errors(comparison):
    errors = np.concatenate(comparison.errors("wrong", "rail", ("push",)))
    summary = comparison.summarise("wrong", "rail", ("push",))
    assert summary.count == len(errors) == 200
    assert summary.mean == pytest.approx(errors.mean())
    assert summary.rms == pytest.approx(np.sqrt((errors**2).mean()))
    assert summary.p95 == pytest.approx(np.percentile(errors, 95))
    assert summary.max == errors.max()


def test_phases_are_free_and_then_the_stages_and_share_out_all_samples(comparison):
    assert comparison.phase_names == ("free", "pick", "push")
    counts = [comparison.summarise("wrong", "rail", (name,)).count for name in comparison.phase_names]
    assert counts == [100, 100, 200]
    assert comparison.contact_phases() == ("push",)
    both = comparison.summarise("wrong", "rail", ("pick", "push"))
    assert (both.count, both.phase) == (300, "pick + push")


def test_before_is_the_first_model_and_the_fall_of_the_error_is_significant(comparison):
    assert (comparison.before, comparison.after) == ("wrong", "right")
    difference = comparison.difference("rail")
    assert difference.verdict == "fallen"
    assert difference.low < difference.mean < difference.high < 0
    before = comparison.summarise("wrong", "rail").mean
    assert difference.share == pytest.approx(difference.mean / before)
    assert comparison.difference("rail", before="right", after="wrong").verdict == "risen"


def test_the_draws_of_tolerances_count_in_the_progress():
    shares, drawn = [], ToleranceCfg(draws=4, min_ratio=1.0)
    compare_replays({"wrong": model(6)}, recorded(model(2)), "mujoco", tolerance_cfg=drawn, progress=shares.append)
    assert shares == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0, 1.0])
    shares.clear()
    compare_replays({"right": model(2)}, recorded(model(2)), "mujoco", progress=shares.append)
    assert shares == [1.0, 1.0]


def test_two_equal_models_differ_by_nothing():
    recording = recorded(model(2))
    found = compare_replays({"a": model(4), "b": model(4)}, recording, "mujoco").difference("rail")
    assert (found.mean, found.low, found.high, found.verdict) == (0, 0, 0, "unclear")


def test_each_model_keeps_its_own_integrator():
    truth = model(2, "Euler")
    recording = recorded(truth)
    found = compare_replays({"other": model(2, "RK4"), "same": truth}, recording, "mujoco")
    assert found.summarise("same", "cart").max < 1e-9
    assert found.summarise("other", "cart").max > 1e-5


def test_main_channel_is_a_body_position_before_a_joint(comparison):
    assert comparison.main_channel() == "cart"


@pytest.mark.parametrize(("extent", "expected"), [(1e-4, "turn"), (0.1, "cart")])
def test_main_channel_of_a_body_whose_origin_stays_is_its_orientation(comparison, extent, expected):
    residuals = {}
    for key, found in comparison.residuals.items():
        cart = replace(next(r for r in found if r.channel == "cart"), extent=extent, std=1e-4)
        residuals[key] = (cart, replace(cart, channel="turn", kind="orientation", unit="rad", extent=0.5))
    assert replace(comparison, residuals=residuals).main_channel() == expected


def test_json_is_valid_and_has_every_channel_phase_and_model(comparison):
    document = json.loads(json.dumps(comparison.to_json(), allow_nan=False))
    keys = {(s["model"], s["channel"], s["phase"]) for s in document["summaries"]}
    assert len(keys) == 2 * 2 * 4
    assert document["headline"]["channel"] == "cart"
    assert document["headline"]["phases"] == ["push"]
    assert document["headline"]["difference"]["verdict"] == "fallen"
    assert document["phases"]["demo_0"][0] == {"name": "free", "start": None, "end": 0.5}


def test_a_model_that_diverges_is_named_and_has_no_finite_error():
    recording = recorded(model(2))
    found = compare_replays({"good": model(2), "wild": model(-600)}, recording, "mujoco")
    assert 0 < found.diverged["wild", "demo_0"] < 2
    assert np.isinf(found.summarise("wild", "rail").mean)
    assert "diverged" in markdown_table(found)
    document = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert document["diverged"][0]["model"] == "wild"


def test_one_model_alone_has_no_difference_and_a_shorter_table():
    found = compare_replays({"only": model(3)}, recorded(model(2)), "mujoco")
    assert found.to_json()["differences"] == []
    assert "change" not in markdown_table(found)


def test_tables_show_lengths_in_mm_with_the_interval(comparison):
    text = markdown_table(comparison)
    summary = comparison.summarise("wrong", "rail")
    assert f"{value_text(summary.mean, 'm')} [{value_text(summary.low, 'm')}, {value_text(summary.high, 'm')}]" in text
    assert text.count("\n") == 2 + 1 + 4
    assert rich_table(comparison).row_count == 1 + 4
    assert rich_table(comparison, every_phase=True).row_count == 2 * 4


@pytest.mark.parametrize("width", [60, 80, 100])
def test_the_table_fits_a_narrow_terminal_and_keeps_what_matters(comparison, width):
    table = rich_table(comparison, every_phase=True, width=width)
    out = StringIO()
    Console(file=out, width=200).print(table)
    lines = out.getvalue().splitlines()
    assert max(map(len, lines)) <= max(width, 76)
    header = lines[1]
    assert all(name in header for name in ("channel", "change", "x noise"))
    assert all(word in out.getvalue() for word in ("pick", "push"))


def test_a_narrow_table_says_which_columns_it_leaves_out(comparison):
    wide, narrow = (rich_table(comparison, width=width) for width in (200, 80))
    assert wide.caption is None
    caption = str(narrow.caption)
    shown = [str(column.header) for column in narrow.columns]
    for name in ("samples", "p95", "max", "RMS", "noise"):
        assert (name in shown) != (name in caption.replace("x noise", ""))
    assert caption.endswith("--json has all")


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [(0.0123, "m", "12.3"), (np.pi, "rad", "180"), (0.5, "N", "0.50"), (None, "m", "-"), (np.inf, "m", "diverged")],
)
def test_numbers_are_shown_in_mm_and_degrees(value, unit, text):
    assert value_text(value, unit) == text


def test_only_the_named_demonstrations_are_compared():
    recording = recorded(model(2), ("demo_0", "demo_1"))
    found = compare_replays({"m": model(2)}, recording, "mujoco", demonstrations=["demo_1"])
    assert found.demonstrations == ("demo_1",)
    with pytest.raises(RecordingError, match="demo_7"):
        compare_replays({"m": model(2)}, recording, "mujoco", demonstrations=["demo_7"])


def test_nothing_to_compare_is_an_error():
    with pytest.raises(ModelError, match="no model"):
        compare_replays({}, recorded(model(2)), "mujoco")
    with pytest.raises(ModelError, match="'elbow'"):
        compare_replays({"m": model(2)}, recorded(model(2)), "mujoco").summarise("m", "elbow")


def test_a_recording_that_measures_nothing_or_what_the_model_lacks_is_an_error():
    recording = recorded(model(2))
    d = replace(recording[0], qpos=None, qvel=None)
    with pytest.raises(RecordingError, match="nothing was measured"):
        compare_replays({"m": model(2)}, replace(recording, demonstrations=(replace(d, measured={}),)), "mujoco")
    bare = Model(Scene(model(2).scene.xml.replace('<jointpos name="rail" joint="rail"/>', "")))
    with pytest.raises(RecordingError, match="add that sensor"):
        compare_replays({"m": bare}, replace(recording, demonstrations=(d,)), "mujoco")


def test_a_summary_can_be_of_some_demonstrations(comparison):
    one = comparison.summarise("wrong", "rail", (), ("demo_1",))
    assert one.count == len(TIME)
    assert one.mean == pytest.approx(comparison.errors("wrong", "rail")[1].mean())
    assert comparison.difference("rail", (), ("demo_1",)).mean < comparison.difference("rail", (), ("demo_0",)).mean < 0


def test_without_any_stage_times_are_not_distinguished():
    found = compare_replays({"m": model(2)}, recorded(model(2)), "mujoco", phases={"demo_0": ()})
    assert found.phase_names == ()
    assert found.to_json()["headline"]["phases"] == []


def test_without_stages_the_ways_of_moving_are_the_phases():
    found = compare_replays({"m": model(6)}, recorded(model(2)), "mujoco")
    assert set(found.phase_names) == {"free"}
    assert found.contact_phases() == ()
    assert found.to_json()["phases_are"] == "phases of motion"


def test_summaries_report_how_far_above_the_noise_the_error_is(comparison):
    wrong, right = (comparison.summarise(name, "rail") for name in ("wrong", "right"))
    assert wrong.ratio == pytest.approx(wrong.rms / wrong.noise)
    assert right.ratio == pytest.approx(1, rel=0.15)
    assert (wrong.source, comparison.summarise("wrong", "cart").source) == ("stated", "differences")
    assert "| x noise |" in markdown_table(comparison)


def test_places_are_those_of_the_last_model(comparison):
    assert "rail" not in {c for p in comparison.worst_spans for c in p.channels}
    swapped = compare_replays({"right": model(2), "wrong": model(6)}, recorded(model(2)), "mujoco")
    assert "rail" in {c for p in swapped.worst_spans for c in p.channels}


def delayed(recording):
    """The same recording with commands that reach the drive 60 ms late."""
    d = recording[0]
    late = Channel(TIME + 0.06, d.action["drive"].value)
    truth = model(2)
    rollout = replay(truth, replace(d, action={"drive": late}), MujocoEngine(truth))
    value = np.interp(TIME, rollout.time, rollout.sensordata[0][:, 0])[:, None]
    return replace(recording, demonstrations=(replace(d, measured={"rail": Channel(TIME, value, 1e-4)}),))


def stale(recording):
    """The same recording with readings that are 50 ms old."""
    d = recording[0]
    rail = d.measured["rail"]
    return replace(recording, demonstrations=(replace(d, measured={"rail": replace(rail, time=TIME + 0.05)}),))


@pytest.mark.parametrize(
    ("effect", "value", "changed"), [(ActuatorDelay("drive"), 0.06, delayed), (Latency("rail"), 0.05, stale)]
)
def test_effects_of_a_model_act_in_its_replay_and_in_predicted_readings(effect, value, changed):
    found = compare_replays(
        {"without": model(2), "with": model(2).add(effect, [value])}, changed(recorded(model(2))), "mujoco"
    )
    without, added = (found.summarise(name, "rail") for name in ("without", "with"))
    assert without.mean > 20 * (added.noise or np.inf)
    assert added.mean < 1.2 * (added.noise or 0)


def test_html_has_a_row_for_each_channel_and_escapes_names():
    truth = model(2)
    found = compare_replays({"wrong <6>": model(6), "right": truth}, recorded(truth), "mujoco")
    page = found._repr_html_()
    assert page.count("<tr>") == 1 + len(found.channels)
    assert "<th>x noise, wrong &lt;6&gt;</th>" in page
    assert "<6>" not in page
    ratio = found.summarise("right", "rail").ratio
    assert ratio is not None
    assert f"<td>{ratio_text(ratio)}</td>" in page
    assert "<td>fallen</td>" in page
    assert "<ol>" not in page  # the last model is nowhere above the noise
    (span, *_) = compare_replays({"right": truth, "wrong": model(6)}, recorded(truth), "mujoco").worst_spans
    page = replace(found, worst_spans=(replace(span, demonstration="<demo>"),))._repr_html_()
    assert f"<li>{escape(replace(span, demonstration='<demo>').sentence(demonstration=True))}</li>" in page
