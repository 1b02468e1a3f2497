import base64
import json
import re
from dataclasses import replace
from html import escape
from itertools import pairwise

import mujoco
import numpy as np
import pytest

from concent_warp.comparison.compare import compare_replays
from concent_warp.comparison.tolerances import ToleranceRange
from concent_warp.comparison.units import value_text
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.report.headline import _overlap_note
from concent_warp.report.opening import first_demonstration, openings
from concent_warp.report.report import write_report
from concent_warp.report.scene_data import scene_bodies
from concent_warp.report.template import filled
from concent_warp.report.worst_spans import numbered_spans, shown_demonstrations
from concent_warp.scene.scene import Scene
from tests.scene.test_unnamed import thrown

PENDULUM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body><joint name="hinge" type="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02"/></body>
  </worldbody>
  <sensor><jointpos name="angle" joint="hinge"/></sensor>
</mujoco>
"""


def embedded(path):
    """The data that the page's scripts read."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', path.read_text(), re.S)
    return json.loads(found[1])


def unpacked(packed):
    return np.frombuffer(base64.b64decode(packed["data"]), dtype="<i4" if packed["type"] == "i" else "<f4")


@pytest.fixture(scope="module")
def text(case):
    return case.path.read_text()


@pytest.fixture(scope="module")
def data(case):
    return embedded(case.path)


def test_the_page_stands_alone(text):
    assert not re.search(r"(src|href)\s*=", text)
    assert not re.search(r"https?://|url\(|@import", text)
    assert "default-src 'none'" in text
    assert "[[" not in re.sub(r"<script.*?</script>", "", text, flags=re.S)


def test_names_from_the_recording_cannot_become_markup(text):
    assert "push the &lt;block&gt; &amp; stop" in text
    assert "push the <block>" not in text
    assert "concent fit &lt;demo.h5&gt;" in text


def test_data_cannot_end_the_script_that_it_stands_in(case, tmp_path):
    renamed = case.recording.scene.replace('name="table"', 'name="&lt;/script&gt;&lt;b&gt;"')
    assert renamed != case.recording.scene
    models = {"m</script>": Model(Scene(renamed))}
    path = tmp_path / "r.html"
    write_report(path, case.recording, compare_replays(models, case.recording, "mujoco"))
    assert "m</script>" not in path.read_text()
    assert embedded(path)["models"][0]["name"] == "m</script>"


def test_the_page_says_what_ordinary_tolerances_would_leave(case, text, tmp_path):
    channel = case.comparison.channels[0]
    beside = replace(case.comparison, tolerances={channel: ToleranceRange(1.2, 3.4)})
    write_report(tmp_path / "r.html", case.recording, beside)
    page = (tmp_path / "r.html").read_text()
    for sentence in beside.tolerance_sentences():
        assert escape(sentence) in page
    assert "1.2 to 3.4 x noise" in page
    assert "Nominal values within" not in text


def test_the_cards_show_the_errors_of_fitted_and_unseen_demonstrations(case, text):
    c = case.comparison
    channel, phases = c.main_channel(), c.contact_phases()
    assert channel == "block_position"
    for chosen in (("demo_0",), ("demo_1",)):
        for model in ("before", "after"):
            assert f">{value_text(c.summarise(model, channel, phases, chosen).mean, 'm')}</span>" in text
    assert "0.41" in text
    assert "0.93" in text
    assert value_text(c.summarise("no contact", channel, phases).mean, "m") in text


def test_lines_carry_the_errors_of_every_channel_and_model(case, data):
    for d in data["demonstrations"]:
        assert d["channels"][0]["name"] == "block_position"
        assert {c["name"] for c in d["channels"]} == set(case.comparison.channels)
        for channel in d["channels"]:
            for model, packed in channel["errors"].items():
                expected = case.comparison.residual(model, d["name"], channel["name"]).error
                assert unpacked(packed) == pytest.approx(expected, abs=1e-6)


def test_phases_cover_the_demonstration_without_gaps(data):
    for d in data["demonstrations"]:
        edges = [(p["start"], p["end"]) for p in d["phases"]]
        assert edges[0][0] == 0
        assert edges[-1][1] == pytest.approx(d["duration"], abs=1e-5)
        assert all(a[1] == b[0] for a, b in pairwise(edges))


def test_the_schedule_is_that_of_the_events(case, data):
    for d in data["demonstrations"]:
        sequence = case.events[d["name"]]
        assert [s["name"] for s in d["schedule"]["stages"]] == [s.name for s in sequence.stages]
        labels = [row["label"] for row in d["schedule"]["rows"]]
        assert "block · stop" in labels
        bars = d["schedule"]["rows"][labels.index("block · stop")]["bars"]
        expected = [[c.start, c.end] for c in sequence.body_contacts if {c.a, c.b} == {"block", "stop"}]
        assert bars == expected


def test_the_replay_has_simulated_and_measured_poses_at_the_same_times(case, data):
    d = data["demonstrations"][0]
    names = [body["name"] for body in data["bodies"]]
    time = unpacked(d["motion"]["time"])
    poses = unpacked(d["motion"]["poses"]["after"]).reshape(len(time), len(names), 7)
    measured = unpacked(d["motion"]["measured"]["block"]).reshape(len(time), 7)
    truth = case.recording["demo_0"].measured["block_position"]
    expected = np.stack([np.interp(time, truth.time, truth.value[:, i]) for i in range(3)], axis=1)
    assert measured[:, :3] == pytest.approx(expected, abs=1e-5)
    assert np.abs(poses[:, names.index("block"), :3] - measured[:, :3]).max() < 0.01
    assert poses[0, names.index("block"), :3] == pytest.approx([0, 0, 0.03], abs=1e-3)
    assert "stop" not in d["motion"]["measured"]
    assert d["motion"]["points"] == {}


def test_tracked_points_stand_in_for_a_pose_that_was_not_measured(case, tmp_path):
    from dataclasses import replace

    d = case.recording["demo_0"]
    blind = replace(case.recording, demonstrations=(replace(d, measured={"rail": d.measured["rail"]}),))
    models = {"model": case.after}
    path = tmp_path / "r.html"
    write_report(path, blind, compare_replays(models, blind, "mujoco"))
    motion = embedded(path)["demonstrations"][0]["motion"]
    assert set(motion["measured"]) == {"pusher"}
    assert motion["points"]["block"]["count"] == 8


def test_bodies_that_measured_joints_move_are_shown_where_the_joints_put_them(case, data):
    motion = data["demonstrations"][0]["motion"]
    time = unpacked(motion["time"])
    pusher = unpacked(motion["measured"]["pusher"]).reshape(len(time), 7)
    rail = case.recording["demo_0"].measured["rail"]
    assert pusher[:, 0] == pytest.approx(-0.13 + np.interp(time, rail.time, rail.value[:, 0]), abs=1e-5)
    assert pusher[:, 2] == pytest.approx(0.04)


def test_the_worst_places_stand_in_the_page_and_can_be_clicked(case, text, data):
    places = [place for _, place in numbered_spans(case.comparison)]
    assert places
    for number, place in enumerate(places, 1):
        assert escape(place.sentence(demonstration=True)) in text
        assert f'data-place="{number}"' in text
    first = data["places"][0]
    assert (first["number"], first["channels"]) == (1, list(places[0].channels))
    assert first["start"] <= first["peak"] <= first["end"]
    assert {p["demonstration"] for p in data["places"]} <= {d["name"] for d in data["demonstrations"]}


def test_demonstrations_with_the_worst_places_are_shown_before_others(case):
    from dataclasses import replace

    names = tuple(f"demo_{i}" for i in range(9))
    place = case.comparison.worst_spans[0]
    many = replace(case.comparison, demonstrations=names, worst_spans=(replace(place, demonstration="demo_7"),))
    assert shown_demonstrations(many, 3) == ("demo_0", "demo_1", "demo_7")


def test_a_place_points_from_the_model_to_the_measurement(case, data):
    arrows = [p for p in data["places"] if p["arrow"]]
    assert arrows
    for p in arrows:
        assert "block_position" in p["channels"] or "block points" in p["channels"]
        r = case.comparison.residual("after", p["demonstration"], "block_position")
        rows = (r.time >= p["start"]) & (r.time <= p["end"])
        assert p["arrow"] == pytest.approx(r.value[rows].mean(axis=0), abs=5e-4)


def test_a_model_as_good_as_the_noise_is_reported_to_be_so(tmp_path):
    m = Scene(PENDULUM).model
    d = mujoco.MjData(m)
    d.qpos[0] = 1
    time, angle = np.arange(0, 2, 0.01), np.zeros(200)
    for i in range(200):
        angle[i] = d.qpos[0]
        mujoco.mj_step(m, d, nstep=2)
    noisy = Channel(time, (angle + np.random.default_rng(0).normal(0, 1e-3, 200))[:, None], 1e-3)
    swing = Demonstration("demo_0", qpos=np.array([1.0]), qvel=np.zeros(1), measured={"angle": noisy})
    recording = Recording(PENDULUM, (swing,))
    models = {"model": Model(Scene(PENDULUM))}
    write_report(tmp_path / "r.html", recording, compare_replays(models, recording, "mujoco"))
    text = (tmp_path / "r.html").read_text()
    assert "at the level of the measurement noise (" in text
    assert "The error is nowhere above 3 x noise" in text
    assert "Noise: as stated." in text
    assert embedded(tmp_path / "r.html")["places"] == []


def test_unexplained_forces_are_reported_and_drawn_where_there_are_any(case, text, data, tmp_path):
    assert "at its &lt;-x&gt; face" in text
    assert [f["label"] for f in data["forces"]] == ["0.412 N, slide"]
    assert 'id="forces-view"' in text
    models = {"model": case.after}
    found = compare_replays(models, case.recording, "mujoco")
    write_report(tmp_path / "r.html", case.recording, found, location={"arrows": [], "sentences": ["nothing"]})
    page = (tmp_path / "r.html").read_text()
    assert "<li>nothing</li>" in page
    assert 'id="forces-view"' not in page
    write_report(tmp_path / "r.html", case.recording, found)
    assert 'id="lacking"' not in (tmp_path / "r.html").read_text()


def test_spheres_are_distinguished_by_what_became_of_them(case, data):
    geometry = data["geometry"]
    state = np.array(geometry["state"])
    assert (state == "moved").sum() == case.moved
    assert set(state) <= {"moved", "touched", "gripped", "other"}
    assert (state == "gripped").any()
    assert geometry["bodies"][0] == "block"
    assert f"{case.moved} moved by 6.0 mm on average" in geometry["facts"]["block"]
    shift = unpacked(geometry["before"]["position"]) - unpacked(geometry["after"]["position"])
    assert (np.abs(shift.reshape(-1, 3)[:, 0]) > 1e-3).sum() == case.moved


def test_a_comparison_of_one_model_without_events_makes_a_report_too(case, tmp_path):
    models = {"model": Model(Scene(case.recording.scene))}
    path = tmp_path / "plain.html"
    write_report(path, case.recording, compare_replays(models, case.recording, "mujoco"))
    page = path.read_text()
    assert 'id="schedule"' not in page
    assert 'id="geometry-0"' not in page
    assert "is off by" in page
    assert [p.name for p in tmp_path.iterdir()] == ["plain.html"]


def test_meshes_of_any_size_stay_small(tmp_path):
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    sphere.export(tmp_path / "ball.obj")
    body = '<body name="b"><freejoint/><geom type="mesh" mesh="ball" mass="1"/></body>'
    asset = '<asset><mesh name="ball" file="ball.obj"/></asset>'
    (tmp_path / "s.xml").write_text(f"<mujoco>{asset}<worldbody>{body}</worldbody></mujoco>")
    bodies, meshes = scene_bodies(Scene.from_mjcf(tmp_path / "s.xml").model)
    assert bodies[0]["geoms"][0]["shape"] == "mesh"
    mesh = meshes[bodies[0]["geoms"][0]["mesh"]]
    vertices = unpacked(mesh["vertices"]).reshape(-1, 3)
    assert len(unpacked(mesh["faces"])) // 3 < len(sphere.faces) / 2
    assert np.linalg.norm(vertices, axis=1) == pytest.approx(0.1, rel=1e-3)


def test_what_is_put_into_a_template_is_not_looked_at_again():
    assert filled("[[a]] [[b]]", {"a": "[[b]]", "b": "x"}) == "[[b]] x"


def test_the_page_opens_on_the_channel_farthest_above_its_noise_at_its_largest_error(case):
    found = openings(case.comparison, ["demo_0", "demo_1"])
    for name, opening in found.items():
        ratios = {
            r.channel: float(np.sqrt(np.nanmean(r.error**2)) / r.noise)
            for r in case.comparison.residuals["after", name]
            if r.noise
        }
        assert opening.channel == max(ratios, key=ratios.__getitem__)
        assert opening.ratio == pytest.approx(ratios[opening.channel])
        residual = case.comparison.residual("after", name, opening.channel)
        assert opening.time == residual.time[np.nanargmax(residual.error)]
    assert first_demonstration(found) == max(found, key=lambda name: found[name].ratio)


def test_where_the_last_model_is_at_the_noise_the_page_opens_on_the_error_of_the_first(case):
    right = replace(case.comparison, models={"before": case.before, "no contact": case.after})
    quiet = {
        key: tuple(replace(r, error=0 * r.error) for r in rows) if key[0] == "no contact" else rows
        for key, rows in case.comparison.residuals.items()
    }
    found = openings(replace(right, residuals=quiet), ["demo_0"])["demo_0"]
    assert found.ratio > 3
    residual = case.comparison.residual("before", "demo_0", found.channel)
    assert found.time == residual.time[np.nanargmax(residual.error)]


@pytest.mark.parametrize(("after", "note"), [(0.3, "It falls:"), (0.6, "It rises:"), (0.41, "")])
def test_the_overlap_card_says_what_a_change_means(after, note):
    found = _overlap_note(0.41, after, 0.02)
    assert note in found
    assert bool(found) == bool(note)


def test_the_replay_begins_as_the_comparison_does_where_no_initial_state_is_recorded(tmp_path):
    recording = thrown()
    assert recording.demonstrations[0].qvel is None
    models = {"model": Model(Scene(recording.scene))}
    write_report(tmp_path / "r.html", recording, compare_replays(models, recording, "mujoco"))
    page = embedded(tmp_path / "r.html")
    motion, names = page["demonstrations"][0]["motion"], [body["name"] for body in page["bodies"]]
    simulated = unpacked(motion["poses"]["model"]).reshape(-1, len(names), 7)[:, names.index("body1"), :3]
    measured = unpacked(motion["measured"]["body1"]).reshape(-1, 7)[:, :3]
    assert np.ptp(measured[:, 0]) > 0.1  # thrown, not dropped
    assert np.abs(simulated - measured).max() < 5e-3
