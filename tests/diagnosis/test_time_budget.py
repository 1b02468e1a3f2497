"""A diagnosis that has to end at a time: the answer so far, and what is not settled."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from concent_warp.diagnosis import time_budget
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.diagnosis.result import VERDICTS
from concent_warp.diagnosis.search import additions, context, find_addition
from concent_warp.diagnosis.tasks import TaskRunner, run_tasks, run_tasks_in_time
from concent_warp.diagnosis.time_budget import TimeBudget, in_words
from concent_warp.model import Model
from concent_warp.report.diagnosis_section import diagnosis_section
from concent_warp.scene.scene import Scene
from concent_warp.simulate import time_limit
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.time_limit import TimeUpError, deadline, stop_at
from tests.diagnosis.search.test_unknown_force_search import FRICTION, bump, rail, ridden
from tests.scenes.swinging import drawing, swung

CFG = DiagnoseCfg(jobs=1, explain=False, effects=("joint_damping", "joint_friction", "armature"))
BALL = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"


@pytest.fixture(scope="module")
def recording():
    return swung(seconds=0.5)


class Clock:
    """Time that passes by a second with each look at it."""

    def __init__(self, monkeypatch):
        self.now = 1000.0
        for module in (time_limit, time_budget):
            monkeypatch.setattr(module.time, "time", self.time)

    def time(self) -> float:
        self.now += 1.0
        return self.now


def ended_after(looks: float, recording, monkeypatch, **changes):
    """Return the diagnosis that ends when the time was looked at so often."""
    with monkeypatch.context() as patch:
        Clock(patch)
        return diagnose(drawing(recording), recording, replace(CFG, seconds=looks, **changes))


def test_simulations_stop_at_the_earliest_of_the_times_that_are_set():
    assert deadline() is None
    with stop_at(None), stop_at(2e12), stop_at(None), stop_at(3e12):
        assert deadline() == 2e12
        with stop_at(1e12):
            assert deadline() == 1e12
        assert deadline() == 2e12
    assert deadline() is None


@pytest.mark.parametrize("threads", [1, 2])
def test_an_engine_raises_once_the_time_is_over(threads):
    engine, variants = MujocoEngine(Model(Scene(BALL)), threads=threads), Variants(3, qvel=np.zeros((3, 6)))
    with stop_at(time.time() + 1e6):
        engine.run(variants, np.zeros((5, 0)))
    for bodies in ([], None):
        with stop_at(time.time() - 1), pytest.raises(TimeUpError):
            engine.run(variants, np.zeros((5, 0)), bodies=bodies)


def simulated(seconds: int) -> int:
    with stop_at(time.time() - 1 if seconds > 2 else None):
        MujocoEngine(Model(Scene(BALL)), threads=1).run(Variants(1), np.zeros((5, 0)))
    return seconds


@pytest.mark.parametrize("jobs", [1, 2])
def test_tasks_that_the_time_does_not_suffice_for_have_no_result(jobs):
    tasks = [(1,), (3,), (2,)]
    assert list(run_tasks_in_time(simulated, tasks, jobs)) == [1, None, 2]
    with pytest.raises(TimeUpError):
        list(run_tasks(simulated, tasks, jobs))
    runner, seen = TaskRunner(jobs), []
    runner.progress = lambda share, text: seen.append((share, text))
    assert runner.run_in_time(simulated, tasks, "simulating", 0.3) == [1, None, 2]
    assert [text for _, text in seen] == [f"simulating, {k} of 3" for k in (1, 2, 3)]
    with pytest.raises(TimeUpError):
        runner.run(simulated, tasks, "simulating")
    with stop_at(time.time() - 1):
        assert list(run_tasks_in_time(simulated, [(1,), (2,)], jobs)) == [None, None]


def test_the_answer_comes_at_any_time_and_says_what_is_open(recording, monkeypatch):
    whole = diagnose(drawing(recording), recording, CFG)
    assert whole.unsettled == ()
    assert whole.verdict == "effect"
    verdicts, sentences = [], []
    for looks in (1, 20, 40, 60, 80, 100, 150, 200, 300, 400, 5000):
        found = ended_after(looks, recording, monkeypatch)
        verdicts.append(found.verdict)
        sentences.append(found.unsettled)
        assert found.verdict in (whole.verdict, "unsettled")
        for f in found.accepted:
            assert f.p <= CFG.significance_level
        if found.verdict != "unsettled":
            assert found.remainder_searched == ("Open: whether another effect is missing." not in found.unsettled)
            assert [f.name for f in found.accepted] == [f.name for f in whole.accepted]
        else:
            assert found.unsettled
        assert found.to_json()["unsettled"] == list(found.unsettled)
        assert found.sentences()[len(found.sentences()) - len(found.unsettled) :] == list(found.unsettled)
        page = diagnosis_section(found.to_json())
        assert ("Not settled in the time given" in page) == bool(found.unsettled)
    assert verdicts[0] == "unsettled"
    assert verdicts[-1] == "effect"
    assert sentences[-1] == ()
    assert any("Open: whether any effect is missing." in said for said in sentences)
    assert any("Not fitted" in s for said in sentences for s in said)


def test_an_effect_that_leaves_an_error_of_form_is_the_answer_where_the_time_ends_during_the_search_after_it(
    monkeypatch,
):
    recording = ridden(friction=FRICTION, force=bump)
    model = Model(Scene(rail()))
    found = {}
    for looks in (120, 220, 400):
        with monkeypatch.context() as patch:
            Clock(patch)
            found[looks] = diagnose(model, recording, replace(CFG, seconds=looks))
    assert [(f.verdict, f.remainder_searched) for f in found.values()] == [
        ("unsettled", None),  # before the effect was fitted
        ("effect", False),
        ("effect", True),
    ]
    said = found[220].sentences()
    assert any(s.startswith("What is left, 1.15 x noise, is 1.2 % of the discrepancy") for s in said)
    assert "Whether something smaller is missing too was not settled in this time." in said
    assert "Open: whether another effect is missing." in found[220].unsettled
    assert found[400].unsettled == ()
    for name in ("verdict", "groups"):
        assert found[220].to_json()[name] == found[400].to_json()[name]
    # Values are those of the given time step, but for what corrections of a longer one leave.
    assert found[220].form_error == pytest.approx(found[400].form_error, rel=1e-3)


def test_parts_that_were_not_finished_are_not_kept(recording, monkeypatch, tmp_path):
    with monkeypatch.context() as patch:
        Clock(patch)
        first = diagnose(drawing(recording), recording, replace(CFG, seconds=60), out=tmp_path)
    assert first.verdict == "unsettled"
    whole = diagnose(drawing(recording), recording, CFG, out=tmp_path)
    alone = diagnose(drawing(recording), recording, CFG)
    assert [f.to_json() for f in whole.effects] == [f.to_json() for f in alone.effects]


def test_nothing_is_named_where_a_rival_was_not_fitted():
    budget = TimeBudget(None)
    for verdict in ("effect", "group", "none_needed", "none_of_these"):
        assert budget.verdict(verdict, [0]) == verdict
    budget.note("Not fitted: drag.", 1)
    assert budget.verdict("effect", [0]) == "effect"
    assert budget.verdict("effect", [0, 1]) == "unsettled"
    assert budget.verdict("group", [1]) == "unsettled"
    assert budget.verdict("none_needed", []) == "unsettled"
    assert budget.verdict("none_of_these", [0]) == "unsettled"
    assert "unsettled" in VERDICTS


def test_work_without_time_gives_the_other_result_and_is_noted_once():
    budget = TimeBudget(1e9)

    def late() -> int:
        raise TimeUpError

    assert budget.attempt(lambda: 3, 4, "A.") == 3
    assert budget.attempt(late, 4, "B.") == 4
    assert budget.attempt(late, 5, "B.") == 5
    assert budget.unsettled == ["B."]
    with budget.until(0.5):
        assert deadline() == budget.begun + 0.5e9
    assert 0.99e9 < budget.left() <= 1e9
    assert TimeBudget(None).left() == np.inf
    with TimeBudget(None).until(0.5):
        assert deadline() is None


def test_many_names_are_counted():
    assert in_words(["a", "b"]) == "a, b"
    assert in_words(list("abcdefgh"), 3) == "a, b, c and 5 more"


def test_shares_of_the_time_leave_some_for_the_end():
    assert 0 < time_budget.SEARCH_SHARE < time_budget.PROFILE_SHARE < time_budget.TOGETHER_SHARE < 1


@pytest.mark.parametrize(("quiet", "verdict"), [(True, "unsettled"), (False, "effect")])
def test_an_effect_beside_little_more_than_noise_is_not_settled_without_what_else_might_explain_that(
    monkeypatch, quiet, verdict
):
    recording = swung(damping=4e-4)
    cfg = replace(CFG, search=replace(CFG.search, doubtful_gain=1.1))
    if quiet:
        for one in (additions, find_addition):
            monkeypatch.setattr(one, "is_near_noise", lambda *_: True)
    assert diagnose(drawing(recording), recording, cfg).verdict == "effect"

    def no_time(*_args):
        raise TimeUpError

    works = [(context, "nominal_sensitivities"), (additions, "finer_time_step"), (find_addition, "refit_from_rivals")]
    for module, work in works:
        with monkeypatch.context() as patch:
            patch.setattr(module, work, no_time)
            found = diagnose(drawing(recording), recording, cfg)
        assert found.verdict == verdict, work
        assert [f.name for f in found.accepted] == ["joint_damping"], work
        assert found.unsettled, work
