"""What a replay in one piece says of an answer that was judged by windows."""

from dataclasses import replace

import numpy as np
import pytest

from concent_warp.comparison.compare import CompareCfg, compare
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.diagnosis.replayed import Replayed, replayed
from concent_warp.diagnosis.result import UnknownForceFound
from concent_warp.fit.effects.observe import observe
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from tests.diagnosis.made_up import finding, node, procedure
from tests.diagnosis.test_diagnosis import diagnosis
from tests.diagnosis.test_failures import XML, recorded


@pytest.fixture(scope="module")
def recording():
    return recorded(damping=1.5)


def test_a_replay_has_the_residuals_that_a_comparison_shows(recording):
    given, better = (Model(Scene(XML.format(damping=damping))) for damping in (0.5, 1.5))
    windows = observe(given, recording)
    found = replayed(given, better, recording, windows, 10.0, "mujoco")
    assert found is not None
    shown = compare({"given": given, "better": better}, recording, CompareCfg(phases="none"))
    assert found.better == pytest.approx(shown.summarise("better", "rail_position").ratio)
    assert found.better == pytest.approx(1.0, abs=0.2)
    assert found.given == pytest.approx(shown.summarise("given", "rail_position").ratio)
    assert found.given > 20
    assert found.window == pytest.approx(max(w.end - w.start for w in windows))
    assert not found.doubtful
    other = replayed(better, given, recording, windows, 10.0, "mujoco")
    assert other is not None
    assert other.doubtful


def test_a_diagnosis_replays_its_better_model(recording):
    model = Model(Scene(XML.format(damping=0.5)))
    cfg = DiagnoseCfg(effects=("joint_damping", "mass"), jobs=1)
    found = diagnose(model, recording, cfg)
    assert [f.name for f in found.accepted] == ["joint_damping"]
    assert found.replayed is not None
    assert found.replayed.better < 1.5 < 20 < found.replayed.given
    assert found.to_json()["replayed"]["doubtful"] is False
    assert not any("in one piece" in sentence for sentence in found.sentences())


def test_a_replay_that_is_far_off_is_said_and_one_that_was_not_done_is_not():
    far = diagnosis(replayed=Replayed(4200.0, 165.4, 0.25, True))
    (said,) = (sentence for sentence in far.sentences() if "in one piece" in sentence)
    for number in ("165 x", "4.2e+03 x", "0.25 s"):
        assert number in said
    assert far.headline == f"{diagnosis().headline}, over short windows"
    for other in (replace(far, replayed=None), replace(far, replayed=Replayed(40.0, 2.0, 0.25, False))):
        assert not any("in one piece" in sentence for sentence in other.sentences())
        assert other.headline == diagnosis().headline
    assert diagnosis().to_json()["replayed"] is None


def test_a_recording_that_cannot_be_replayed_says_nothing(recording):
    model = Model(Scene(XML.format(damping=0.5)))
    channel = recording[0].measured["rail_position"]
    unread = replace(channel, value=np.full_like(channel.value, np.nan))
    empty = replace(recording, demonstrations=(replace(recording[0], measured={"rail_position": unread}),))
    assert replayed(model, model, empty, observe(model, recording), 10.0, "mujoco") is None


@pytest.mark.parametrize(
    ("ratio", "accepted", "verdict", "stays"),
    [(1.0, False, "none_needed", True), (1.6, True, "none_of_these", True), (1.0, True, "effect", False)],
)
def test_what_is_not_named_is_saved_only_where_it_follows_the_recording_better(
    monkeypatch, ratio, accepted, verdict, stays
):
    least = 1.87 if verdict == "none_of_these" else 2.05  # a fifth of the squared residual above the noise, or none
    for better, worse in ((least + 0.1, True), (least - 0.1, False)):
        made, given, last = procedure(), node(3.0), node(ratio, effects=1)
        monkeypatch.setattr(made, "_replayed", lambda *_, better=better: Replayed(2.0, better, 0.5, False))
        monkeypatch.setattr("concent_warp.diagnosis.procedure.beyond_effects", lambda *_, **__: None)
        made.record.findings = [finding("mass", 0.5)] if accepted else []
        found = made.conclude(given, [given, last] if accepted else [last], (), ())
        assert found.verdict == verdict
        assert found.explains == (not (stays and worse))
        assert found.model is (found.models[0] if stays and worse else found.models[-1])
        assert any("stays as given" in sentence for sentence in found.sentences()) == (stays and worse)
        assert found.replayed is None
    # Where nothing was changed there is nothing to replay.
    made = procedure()
    monkeypatch.setattr(made, "_replayed", lambda *_: pytest.fail("replayed"))
    given = node(1.0)
    assert made.conclude(given, [given], (), ()).explains


@pytest.mark.parametrize(
    ("ratio", "varies", "verdict"),
    [(1.0, True, "none_needed"), (1.0, False, "none_of_these"), (3.0, True, "none_of_these")],
)
def test_a_value_that_changes_from_window_to_window_is_no_effect_where_noise_explains_the_data(
    monkeypatch, ratio, varies, verdict
):
    made, given, last = procedure(), node(ratio), node(0.9, effects=1)
    made.record.findings, made.record.groups = [finding("mass", 0.14)], [("mass",)]
    found = UnknownForceFound("mass with another value in each window", 0.1, 0.001, 0.5, varies=varies)
    monkeypatch.setattr("concent_warp.diagnosis.procedure.beyond_effects", lambda *_, **__: found)
    monkeypatch.setattr(made, "_replayed", lambda *_: None)
    said = made.conclude(given, [given, last], (), ())
    assert said.verdict == verdict
    assert said.groups == (() if verdict == "none_needed" else (("mass",),))
    assert [f.accepted for f in said.effects] == [verdict != "none_needed"]
    assert (said.unknown_force is None) == (verdict == "none_needed")
    assert len(said.models) == (1 if verdict == "none_needed" else 2)
