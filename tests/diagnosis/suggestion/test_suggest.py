import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from concent_warp.diagnosis.suggestion import search as search_module
from concent_warp.diagnosis.suggestion import suggest as module
from concent_warp.diagnosis.suggestion.cfg import MotionLimitsCfg, SuggestCfg
from concent_warp.diagnosis.suggestion.evaluations import Evaluations
from concent_warp.diagnosis.suggestion.search import Search
from concent_warp.diagnosis.suggestion.suggest import EVALUATIONS_FILE, suggest
from concent_warp.errors import ConcentError
from concent_warp.model import Model
from concent_warp.recording.load import load_recording
from concent_warp.report.suggestion.page import write_motion_page
from concent_warp.scene.scene import Scene
from tests.diagnosis.suggestion.carts import one_speed, open_group

RECORDING = one_speed(friction=0.2)
MODEL = Model(Scene(RECORDING.scene))
QUICK = SuggestCfg(payloads=False, evaluations=16, population=8, duration=3.0, sufficient=1e6)


@pytest.fixture(scope="module")
def found():
    return suggest(MODEL, RECORDING, QUICK, diagnosis=open_group())


@pytest.fixture(scope="module")
def menu():
    return suggest(MODEL, RECORDING, replace(QUICK, method="menu"), diagnosis=open_group())


def test_a_motion_is_found_that_decides_a_group(found):
    assert found.found
    assert all(pair.resolved and pair.evidence >= found.needed for pair in found.pairs)
    assert found.duration <= 3.0
    assert found.used["speed"] <= 1.0
    assert found.used["force"] <= 1.0
    assert set(found.predictions) == {"joint_friction", "joint_damping"}
    assert "nat" in found.sentence


def test_its_files_hold_the_same_commands(found, tmp_path):
    written = found.save(tmp_path / "motion.h5")
    assert [path.name for path in written] == ["motion.h5", "motion.csv"]
    sent = load_recording(tmp_path / "motion.h5")[0].action["drive"]
    with (tmp_path / "motion.csv").open() as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["time", "drive"]
    table = np.array(rows[1:], dtype=float)
    assert np.interp(table[:, 0], sent.time, sent.value) == pytest.approx(table[:, 1], abs=1e-6)
    assert np.abs(np.diff(table[:, 1])).max() <= 0.1 * 0.01 * 1.05


def test_the_search_does_no_worse_than_the_menu_and_than_chance(found, menu):
    chance = suggest(MODEL, RECORDING, replace(QUICK, method="random"), diagnosis=open_group())
    least = [min(pair.evidence for pair in one.pairs) for one in (found, menu, chance)]
    assert least[0] >= 0.99 * max(least)


def test_a_motion_by_chance_is_suggested_even_where_it_is_expected_to_decide_nothing():
    chance = suggest(MODEL, RECORDING, replace(QUICK, method="random", decisive=1e6), diagnosis=open_group())
    assert chance.found
    assert not any(pair.resolved for pair in chance.pairs)
    assert "expected to decide nothing" in chance.sentence


def test_wider_limits_are_proposed_where_they_may_bring_what_is_needed(menu):
    most = max(pair.evidence for pair in menu.pairs) / menu.needed
    for share, text in ((0.9, "Wider limits may do."), (0.01, "would hardly do either")):
        far = replace(QUICK, method="menu", decisive=QUICK.decisive * most / share)
        nothing = suggest(MODEL, RECORDING, far, diagnosis=open_group())
        assert not nothing.found
        assert text in nothing.sentence


def test_nothing_is_suggested_where_no_motion_is_within_the_limits():
    still = replace(QUICK, method="menu", limits=MotionLimitsCfg(workspace=(5, 5, 5, 6, 6, 6)))
    nothing = suggest(MODEL, RECORDING, still, diagnosis=open_group())
    assert not nothing.found
    assert nothing.sentence == "No motion is within the limits: the nearest one exceeds workspace."
    with pytest.raises(ConcentError, match="there is no motion to write"):
        nothing.save("motion.h5")


def test_an_interrupted_search_continues_with_the_same_result(found, tmp_path, monkeypatch):
    rate, calls = Search._rated, []

    def stopped(self, candidates, *, starts):
        if len(calls) == 2:
            raise KeyboardInterrupt
        calls.append(len(candidates))
        return rate(self, candidates, starts=starts)

    monkeypatch.setattr(Search, "_rated", stopped)
    with pytest.raises(KeyboardInterrupt):
        suggest(MODEL, RECORDING, QUICK, diagnosis=open_group(), state=tmp_path)
    known = sum("careful" not in key for key in Evaluations(tmp_path / EVALUATIONS_FILE).known)
    assert known >= sum(calls)
    fresh = []
    monkeypatch.setattr(
        Search,
        "_rated",
        lambda self, candidates, *, starts: fresh.append(len(candidates)) or rate(self, candidates, starts=starts),
    )
    monkeypatch.setattr(module, "fit_effects", lambda *_, **__: pytest.fail("fitted again"))
    again = suggest(MODEL, RECORDING, QUICK, diagnosis=open_group(), state=tmp_path)
    assert again.to_json() == found.to_json()
    assert sum(fresh) == sum("careful" not in key for key in Evaluations(tmp_path / EVALUATIONS_FILE).known) - known


def test_what_one_method_has_simulated_another_one_reads(found, menu, tmp_path, monkeypatch):
    assert suggest(MODEL, RECORDING, QUICK, diagnosis=open_group(), state=tmp_path).to_json() == found.to_json()
    rate = Search._rated

    def known(self, candidates, *, starts):
        assert not candidates
        return rate(self, candidates, starts=starts)

    monkeypatch.setattr(Search, "_rated", known)
    monkeypatch.setattr(Search, "forecast", lambda *_, **__: pytest.fail("simulated again"))
    again = suggest(MODEL, RECORDING, replace(QUICK, method="menu"), diagnosis=open_group(), state=tmp_path)
    assert again.to_json() == menu.to_json()


def test_a_weight_is_asked_for_where_no_motion_is_clear(found, tmp_path):
    assert min(pair.separation for pair in found.pairs) < SuggestCfg().clear_separation
    heavy = suggest(MODEL, RECORDING, replace(QUICK, payloads=True), diagnosis=open_group())
    ((weight,),) = heavy.to_json()["payloads"]
    assert weight["body"] == "cart"
    assert f"With {weight['mass']:g} kg at " in heavy.sentence
    written = heavy.save(tmp_path / "motion.h5")
    assert [path.name for path in written] == ["motion.h5", "motion.csv", "motion.payloads.csv"]
    (kept,) = load_recording(written[0])[0].payloads
    assert (kept.body, kept.mass) == (weight["body"], weight["mass"])
    assert min(p.separation for p in heavy.pairs) >= min(p.separation for p in found.pairs)
    write_motion_page(tmp_path / "motion.html", heavy)
    data = re.search(r'<script[^>]*id="data">(.*?)</script>', (tmp_path / "motion.html").read_text(), re.DOTALL)
    assert data is not None
    ((ball,),) = (one["weights"]["cart"] for one in json.loads(data[1])["motions"])
    assert 4 / 3 * np.pi * ball["size"][0] ** 3 * 7870 == pytest.approx(weight["mass"], rel=1e-2)
    assert ball["position"] == pytest.approx(weight["position"])


def test_nothing_is_searched_where_the_menu_is_expected_to_decide(menu, monkeypatch):
    margin = min(pair.evidence for pair in menu.pairs) / menu.needed
    least = replace(QUICK, sufficient=0.9 * margin, clear_separation=1e6)
    searched, optimised = [], Search.optimised
    monkeypatch.setattr(Search, "optimised", lambda self, **_: searched.append(1) or optimised(self))
    assert suggest(MODEL, RECORDING, least, diagnosis=open_group()).to_json() == menu.to_json()
    assert not searched
    suggest(MODEL, RECORDING, replace(least, sufficient=1.1 * margin), diagnosis=open_group())
    assert searched


def test_a_search_ends_where_it_finds_nothing_better(monkeypatch):
    evolved, counts = Search._evolved, []

    monkeypatch.setattr(Search, "_evolved", lambda self, family, *_: evolved(self, family, counts.append))
    for gain, most in ((1e-6, 5), (1e3, 3)):
        counts.clear()
        cfg = replace(QUICK, method="optimised", evaluations=20, population=4, patience=2, min_gain=gain, enough=1e6)
        suggest(MODEL, RECORDING, cfg, diagnosis=open_group())
        assert len(counts) <= most
    assert len(counts) == 3


def test_motions_out_of_limits_are_not_forecast(monkeypatch):
    monkeypatch.setattr(search_module, "forecasts", lambda *args, **_: pytest.fail("forecast") if args[2] else [])
    still = replace(QUICK, method="menu", limits=MotionLimitsCfg(workspace=(5, 5, 5, 6, 6, 6)))
    assert not suggest(MODEL, RECORDING, still, diagnosis=open_group()).found
