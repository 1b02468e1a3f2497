"""How far hypotheses differ in a motion, and the motion as arrays, against formulas."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.diagnosis.experiment import suggest
from concent_warp.diagnosis.experiment.cfg import SuggestExperimentCfg
from concent_warp.diagnosis.experiment.future_window import difference_in_noise, future_window
from concent_warp.diagnosis.experiment.motions import ProposedMotion, RecordedRange
from concent_warp.diagnosis.experiment.suggest import (
    _experiment,
    _score,
    _separations,
    _start_effects,
    suggest_experiment,
)
from concent_warp.diagnosis.experiment.suggested import ObjectMotion, SuggestedMotion, TimeSeries
from concent_warp.diagnosis.experiment.trajectory import command_unit, joint_unit, motion_trajectory
from concent_warp.effects.library.drives import ActuatorDelay
from concent_warp.effects.library.joints import JointDamping
from concent_warp.effects.library.measurement import SensorBias, SensorGain
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

XML = """
<mujoco><option timestep="0.004" integrator="implicitfast" gravity="0 0 -2"/><worldbody>
  <body name="cart"><joint name="rail" type="slide" axis="1 0 0"/><geom size=".1" mass="1" contype="0"/>
    <body name="arm"><joint name="turn" axis="0 0 1"/><geom size=".1" mass="1" pos=".1 0 0" contype="0"/></body></body>
  <body name="ball" pos="0 0 3"><freejoint/><geom size=".1" mass="1"/></body>
  <body name="other" pos="5 0 3"><freejoint/><geom size=".1" mass="1"/></body></worldbody>
<actuator><position name="drive" joint="rail" kp="100" kv="5"/><motor name="push" joint="rail"/>
  <position name="spin" joint="turn" kp="3" kv="1"/></actuator>
<sensor><jointpos name="rail_position" joint="rail"/><jointpos name="angle" joint="turn"/>
  <framepos name="place" objtype="body" objname="ball"/>
  <framequat name="turned" objtype="body" objname="ball"/></sensor></mujoco>"""
NOISE = {"rail_position": 1e-3, "place": 2e-3, "turned": 1e-2}


def recorded(**noise: float) -> RecordedRange:
    """Return what was recorded: a second at 100 Hz, a place at 20 Hz."""
    model = Model(Scene(XML))
    time, slow = np.arange(0, 1.001, 0.01), np.arange(0, 1.001, 0.05)
    measured = {"rail_position": Channel(time, 0 * time[:, None]), "place": Channel(slow, np.zeros((len(slow), 3)))}
    action = {n: Channel(np.zeros(1), np.zeros(1)) for n in ("drive", "push", "spin")}
    d = Demonstration("d", qpos=model.scene.model.qpos0, qvel=np.zeros(14), action=action, measured=measured)
    return RecordedRange(model, Recording(XML, (d,)), noise or NOISE)


def motion(known: RecordedRange, duration: float = 0.5, **changes: Any) -> ProposedMotion:
    """Return a motion from rest in which the cart is commanded to 0.1 m and the ball flies and turns."""
    qvel = np.zeros(14)
    qvel[2:8] = [0.3, 0.2, 0.1, 0.5, 1.0, -2.0]
    action = {
        n: Channel(np.array([0.0, 0.1]), np.array([0.0, x])) for n, x in (("drive", 0.1), ("push", 0), ("spin", 1))
    }
    base = ProposedMotion("m", "do it", duration, known.m.qpos0.copy(), qvel, action)
    return replace(base, **changes)


def test_a_future_window_has_the_samples_of_each_channel_that_is_measured():
    known = recorded()
    made = motion(known)
    window = future_window(known, made, 0.3)
    assert window is not None
    assert [r.channel for r in window.readings] == list(NOISE)
    times = [np.arange(0, 0.3, step) for step in (0.01, 0.05, 0.01)]
    for r, time, dim, values in zip(window.readings, times, (1, 3, 3), (1, 3, 4), strict=True):
        np.testing.assert_allclose(r.time, time)
        assert (r.value.shape, r.std, r.orientation) == ((len(time), values), NOISE[r.channel], r.channel == "turned")
        assert r.rows.stop - r.rows.start == dim * len(time)
        np.testing.assert_allclose(window.clock[r.rows], np.repeat(time, dim))
    assert all(a.rows.stop == b.rows.start for a, b in pairwise(window.readings))
    assert (window.count, window.start, window.end, window.number) == (30 + 18 + 90, 0.0, 0.3, 0)
    np.testing.assert_array_equal(window.qpos, made.qpos)
    np.testing.assert_array_equal(window.qvel, made.qvel)
    assert not window.start_shown  # it starts as the motion does, whatever the instruments show
    gone = future_window(known, replace(made, away=("ball",)), 0.3)
    assert gone is not None
    assert [r.channel for r in gone.readings] == ["rail_position"]
    assert future_window(recorded(place=1e-3), replace(made, away=("ball",)), 0.3) is None
    fine = RecordedRange(known.model, known.recording, {"angle": 1e-3})
    fine.period["angle"] = 0.001
    quick = future_window(fine, made, 0.1)
    assert quick is not None
    np.testing.assert_allclose(quick.readings[0].time, np.arange(0, 0.1, 0.004))


def test_readings_differ_by_their_noise_and_orientations_by_their_angle():
    known = recorded()
    window = future_window(known, motion(known), 0.3)
    assert window is not None
    rng = np.random.default_rng(0)
    turns = [Rotation.from_rotvec(rng.normal(0, 0.3, (30, 3))) for _ in range(2)]
    sets = [[rng.normal(size=(30, 1)), rng.normal(size=(6, 3)), turn.as_quat(scalar_first=True)] for turn in turns]
    found = difference_in_noise(window, sets[0], sets[1])
    np.testing.assert_allclose(found[:30], (sets[0][0] - sets[1][0]).ravel() / 1e-3)
    np.testing.assert_allclose(found[30:48], (sets[0][1] - sets[1][1]).ravel() / 2e-3)
    angle = np.linalg.norm(found[48:].reshape(30, 3), axis=1) * 1e-2
    np.testing.assert_allclose(angle, (turns[0].inv() * turns[1]).magnitude(), rtol=1e-6)


def test_hypotheses_are_separated_in_the_channel_where_they_differ_most():
    known = recorded()
    made = motion(known)
    plain = known.model
    models = {
        "plain": plain,
        "bias": plain.add(SensorBias("rail_position", "angle"), [3e-3, 0.5]),
        "gain": plain.add(SensorGain("rail_position", "angle"), [0.2, 0.0]),
    }
    window = future_window(known, made, 0.5)
    assert window is not None
    found = _separations(models, made, window, "mujoco")
    assert found is not None
    assert list(found) == [("plain", "bias"), ("plain", "gain"), ("bias", "gain")]
    assert found["plain", "bias"] == (pytest.approx(3.0), "rail_position")
    rail = motion_trajectory(plain, made, "mujoco", 100.0).joints["rail"]
    read = np.interp(window.readings[0].time, rail.time, rail.value)
    assert found["plain", "gain"][0] == pytest.approx(np.sqrt(np.mean((0.2 * read) ** 2)) / 1e-3, rel=0.02)
    starts = np.random.default_rng(0).normal(size=(window.count, 4))
    left = _separations(models, made, window, "mujoco", starts)
    assert left is not None
    residual = np.zeros(window.count)
    residual[window.readings[0].rows] = -3.0
    residual -= starts @ np.linalg.solve(starts.T @ starts + np.eye(4), starts.T @ residual)
    sizes = [(np.sqrt(np.mean(residual[r.rows] ** 2)), r.channel) for r in window.readings]
    assert left["plain", "bias"] == (pytest.approx(max(sizes)[0]), max(sizes)[1])

    def breaks(_model):
        raise ValueError("a body is missing")

    assert _separations(models, replace(made, change=breaks), window, "mujoco") is None
    assert _score(found) == pytest.approx(np.mean([np.log1p(v) for v, _ in found.values()]))


def test_effects_of_the_start_are_those_of_its_standard_deviations():
    known = recorded()
    made = motion(known)
    window = future_window(known, made, 0.3)
    assert window is not None
    found = _start_effects(known.model, window, "mujoco", 0.1)
    assert found is not None
    assert found.shape == (window.count, 28)
    rail = window.readings[0]
    assert abs(found[0, 0]) == pytest.approx(window.spread[0] / 1e-3, rel=1e-3)
    step = abs(found[rail.rows, 14])
    assert step[1] == pytest.approx(window.spread[14] * 0.01 / 1e-3, rel=0.15)
    place = window.readings[1]
    np.testing.assert_allclose(np.abs(found[place.rows, 2][::3]), window.spread[2] / 2e-3, rtol=1e-3)
    np.testing.assert_allclose(np.abs(found[place.rows, 2][1::3]), 0, atol=1e-6)
    twice = _start_effects(known.model, window, "mujoco", 0.2)
    assert twice is not None
    np.testing.assert_allclose(twice[rail.rows], found[rail.rows], rtol=1e-2, atol=1e-3)
    wild = motion(known, qvel=np.full(14, 1e12))
    lost = future_window(known, wild, 0.3)
    assert lost is not None
    assert _start_effects(known.model, lost, "mujoco", 0.1) is None


def test_a_motion_is_sampled_as_a_model_with_its_effects_predicts_it():
    known = recorded()
    made = motion(known, away=("other",))
    model = known.model.add(ActuatorDelay("drive"), [0.1]).add(JointDamping("rail"), [3.0])
    found = motion_trajectory(model, made, "mujoco", 50.0)
    m = model.compile()
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = made.qpos, made.qvel
    states = [(d.qpos.copy(), d.qvel.copy())]
    for k in range(125):
        delayed = np.interp(k * 0.004 - 0.1, [0.0, 0.096, 0.1], [0.0, 0.0, 0.1])
        d.ctrl[:] = [delayed, 0.0, 1.0 if k >= 25 else 0.0]
        mujoco.mj_step(m, d)
        states.append((d.qpos.copy(), d.qvel.copy()))
    rows = np.arange(0, 126, 5)
    qpos, qvel = (np.array([s[i] for s in states])[rows] for i in (0, 1))
    time = 0.004 * rows
    assert set(found.joints) == {"rail", "turn"}
    assert [found.joints[n].unit for n in ("rail", "turn")] == ["m", "rad"]
    for i, name in enumerate(("rail", "turn")):
        np.testing.assert_allclose(found.joints[name].time, time)
        np.testing.assert_allclose(found.joints[name].value, qpos[:, i], atol=1e-9)
    assert set(found.objects) == {"ball"}
    ball = found.objects["ball"]
    np.testing.assert_allclose(ball.position, qpos[:, 2:5], atol=1e-9)
    np.testing.assert_allclose(ball.orientation, qpos[:, 5:9], atol=1e-9)
    np.testing.assert_allclose(ball.velocity, qvel[:, 2:5], atol=1e-9)
    spin = Rotation.from_quat(qpos[:, 5:9], scalar_first=True).apply(qvel[:, 5:8])
    np.testing.assert_allclose(ball.angular_velocity, spin, atol=1e-9)
    assert {n: (c.unit, c.value.tolist()) for n, c in found.commands.items()} == {
        "drive": ("m", [0.0, 0.1]), "push": ("-", [0.0, 0.0]), "spin": ("rad", [0.0, 1.0]),
    }  # fmt: skip
    assert found.duration == 0.5
    assert found.away == ("other",)
    dense = motion_trajectory(model, replace(made, duration=0.001), "mujoco", 1e6)
    np.testing.assert_allclose(dense.joints["rail"].time, [0, 0.004])
    assert (joint_unit(m, 0), joint_unit(m, 1), command_unit(m, "push")) == ("m", "rad", "-")


def test_an_experiment_names_how_far_the_likeliest_differs_from_each_other():
    known = recorded()
    made = motion(known)
    models = {n: known.model.add(JointDamping("rail"), [x]) for n, x in (("a", 0.0), ("b", 2.0), ("c", 4.0))}
    found: Any = {("a", "b"): (2.0, "place"), ("a", "c"): (5.0, "rail_position"), ("b", "c"): (7.0, "rail_position")}
    made_of = _experiment(made, found, models, known, "mujoco")
    assert made_of.sentence == ("do it: a and c then differ by 5.0 x noise, a and b by 2.0 x (rail position).")
    assert (made_of.pair, made_of.separation, made_of.channel) == (("b", "c"), 7.0, "rail_position")
    assert made_of.separations == {("a", "b"): 2.0, ("a", "c"): 5.0, ("b", "c"): 7.0}
    assert set(made_of.predictions) == set("abc")
    prediction = made_of.predictions["c"]
    np.testing.assert_allclose(prediction.time, np.arange(0, 0.5, 0.01))
    assert prediction.unit == "m"
    rail = motion_trajectory(models["c"], made, "mujoco", 250.0).joints["rail"]
    np.testing.assert_allclose(prediction.value[:, 0], np.interp(prediction.time, rail.time, rail.value), atol=1e-6)
    turned: Any = {pair: (value, "turned") for pair, (value, _) in found.items()}
    assert _experiment(made, turned, models, known, "mujoco").predictions["a"].unit == "-"


def test_of_all_motions_the_best_of_the_finalists_is_suggested(monkeypatch):
    known = recorded()
    menu = [motion(known, text=f"motion {k}") for k in range(5)]
    values = {menu[k].text: v for k, v in enumerate((3.0, 0.0, 9.0, 8.0, 1.0))}
    reported, judged = [], []
    pair = ("a", "b")

    def first(_models, _recorded, found, _engine):
        return {pair: (values[found.text], "place")} if values[found.text] else None

    def second(_models, _recorded, found, _engine, _cfg):
        judged.append(found.text)
        return {pair: ({"motion 2": 2.0, "motion 3": 4.0, "motion 0": 3.0}[found.text], "place")}

    monkeypatch.setattr(suggest, "drive_motions", lambda *_: menu[:2])
    monkeypatch.setattr(suggest, "body_motions", lambda *_: menu[2:])
    monkeypatch.setattr(suggest, "channel_noises", lambda *_: NOISE)
    monkeypatch.setattr(suggest, "_known_start_separations", first)
    monkeypatch.setattr(suggest, "_uncertain_start_separations", second)
    monkeypatch.setattr(suggest, "_experiment", lambda chosen, found, *_: (chosen, found))
    models: dict[str, Model] = {name: known.model for name in ("a", "b", "c")}  # noqa: C420
    cfg = replace(SuggestExperimentCfg(), finalists=3, min_separation=4.0, max_hypotheses=2)
    found: Any = suggest_experiment(models, known.recording, cfg, progress=reported.append)
    assert found[0] is menu[3]
    assert judged == ["motion 2", "motion 3", "motion 0"]
    assert reported == pytest.approx([*(k / 8 for k in range(1, 9)), 1.0])
    assert suggest_experiment(models, known.recording, replace(cfg, min_separation=4.1)) is None
    assert suggest_experiment(models, known.recording, replace(cfg, max_hypotheses=1)) is None
    monkeypatch.setattr(suggest, "_uncertain_start_separations", lambda *_: None)
    assert suggest_experiment(models, known.recording, cfg) is None


def test_a_motion_is_plain_in_json():
    series = TimeSeries(np.arange(2.0), np.arange(2.0), "m")
    thing = ObjectMotion(np.arange(1.0), np.zeros((1, 3)), np.eye(4)[:1], np.ones((1, 3)), np.zeros((1, 3)))
    document = SuggestedMotion(1.5, {"c": series}, {"j": series}, {"o": thing}, ("x",)).to_json()
    assert (document["duration"], document["away"]) == (1.5, ["x"])
    assert document["commands"]["c"] == document["joints"]["j"] == {"time": [0, 1], "value": [0, 1], "unit": "m"}
    assert document["objects"]["o"]["orientation"] == [[1, 0, 0, 0]]
    assert document["objects"]["o"]["units"]["angular_velocity"] == "rad/s"
