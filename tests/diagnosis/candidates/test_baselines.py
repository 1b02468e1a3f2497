"""When baselines and candidates are fitted again and which fit is kept, with solvers that are made up."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.diagnosis.candidates import baseline, evidence, fit_candidate, gradient_start, profile_likelihood
from concent_warp.diagnosis.candidates.baseline import fit_baseline, refit_from_rivals
from concent_warp.diagnosis.candidates.fit_candidate import polish_candidate, restart_candidate
from concent_warp.diagnosis.candidates.gradient_start import start_from_factor
from concent_warp.diagnosis.candidates.profile_likelihood import _next_distances, _profile
from concent_warp.diagnosis.cfg import DiagnoseCfg, ProfileLikelihoodCfg, SearchCfg
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.effects.effect import Parameter
from concent_warp.fit.effects.cfg import EffectSolverCfg
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.observe import observe
from concent_warp.fit.effects.prediction import Prediction
from concent_warp.fit.effects.robust import huber, huber_limit
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from concent_warp.simulate.time_limit import stop_at
from tests.scenes.bouncing import bounced

ANY: Any = None
SETTINGS = EffectSolverCfg()


@dataclass(frozen=True)
class Fit:
    """A fit with a name and a cost."""

    name: str
    cost: float = 10.0
    values: Any = (1.0,)
    offsets: Any = (np.array([0.5]),)
    starts: Any = "starts"
    polished: bool = False
    rough: Any = ()


@pytest.mark.parametrize(("values", "polished"), [((1.0,), True), ((), False)])
def test_parameters_of_the_baseline_get_a_second_fit(monkeypatch, values, polished):
    done: list[Any] = []
    solver = SimpleNamespace(
        p=SimpleNamespace(start="start", model=lambda v: f"model at {v}"),
        fit_initial_states=lambda start, offsets: done.append((start, [o.tolist() for o in offsets])) or ("o", "s"),
        fit=lambda start, offsets, starts: done.append((start, offsets, starts)) or Fit("fit", values=values),
        polish=lambda fit: replace(fit, name="polished"),
    )
    monkeypatch.setattr(baseline, "Prediction", lambda *_, **__: ANY)
    monkeypatch.setattr(baseline, "Solver", lambda *_: solver)
    monkeypatch.setattr(baseline, "fitted_model", lambda model, _w, _b, fit, *_: (model, fit.name))
    windows: Any = [SimpleNamespace(spread=np.ones(2)), SimpleNamespace(spread=np.ones(4))]
    found: Any = fit_baseline("model", windows, ANY)  # pyright: ignore[reportArgumentType]
    assert found == ((f"model at {values}", "polished") if polished else ("model", "fit"))
    assert done == [("start", [[0, 0], [0, 0, 0, 0]]), (None, "o", "s")]


def test_a_fit_that_was_found_as_the_time_ended_is_kept():
    recording, _ = bounced(2, off=0.0)
    model = Model(Scene(recording.scene))
    windows = observe(model, recording)
    blocks = cut_blocks(windows)
    found = fit_baseline(model, windows, blocks)
    far = replace(found.fit, linear=tuple(replace(w, residual=w.residual + 9.0) for w in found.fit.linear))
    asked: list[int] = []

    def simulated(self: Prediction, trials: Any) -> list[np.ndarray]:
        asked.append(len(trials))
        return residuals(self, trials)

    with pytest.MonkeyPatch.context() as patch, stop_at(time.time() - 1):
        residuals = Prediction.residuals
        patch.setattr(Prediction, "residuals", simulated)
        late = baseline.fitted_model(model, windows, blocks, far, found.engine, found.cfg)
    assert asked  # derivatives that foretell much are tried
    assert late.fit.cost == found.fit.cost


@dataclass(frozen=True)
class Base:
    """A baseline that is made up."""

    errors: np.ndarray
    limit: float = 4.0
    name: str = "base"
    model: Any = None
    windows: Any = (1,)
    blocks: Any = None
    engine: Any = "mujoco"
    cfg: Any = SETTINGS
    fit: Any = Fit("base")
    pieces: Any = ()
    made: Any = None

    def solver(self, *_: Any, **__: Any) -> Any:
        """Return the solver."""
        return self.made

    def prediction(self, *_: Any) -> Any:
        """Return the parameters."""
        return self.made.p


@pytest.mark.parametrize(("left", "better"), [(1.9, True), (2.0, False), (2.1, False)])
def test_a_baseline_is_replaced_where_states_of_its_rivals_leave_less(monkeypatch, left, better):
    tried: list[Any] = []
    solver = SimpleNamespace(improve_initial_states=lambda fit, offsets: tried.append((fit, offsets)) or "improved")
    base: Any = Base(np.array([1.0, 1.0]), made=solver)
    found: Any = Base(np.array([left, 0.0]), limit=9.0, name="found")
    monkeypatch.setattr(baseline, "fitted_model", lambda *args: found if args[3] == "improved" else ANY)
    rivals: Any = [SimpleNamespace(fit=SimpleNamespace(offsets=k)) for k in "ab"]
    after: Any = refit_from_rivals(base, rivals)
    assert tried == [(base.fit, ["a", "b"])]
    assert (after.name, after.limit) == (("found", 4.0) if better else ("base", 4.0))


@dataclass(frozen=True)
class Candidate:
    """A fitted candidate that is made up."""

    fit: Any
    effect: Any = "effect"
    polished: bool = False


def made_up_fits(monkeypatch, solver: Any) -> None:
    """Let candidates be fitted by a solver."""
    monkeypatch.setattr(fit_candidate, "candidate_solver", lambda *_: solver)
    monkeypatch.setattr(fit_candidate, "fitted_candidate", lambda _base, effect, _solver, fit: Candidate(fit, effect))


@pytest.mark.parametrize(
    ("cost", "name", "polished"), [(9.0, "new", False), (9.89, "new", False), (9.91, "new", True), (10.5, "old", True)]
)
def test_a_polished_fit_is_kept_where_it_costs_less(monkeypatch, cost, name, polished):
    asked: list[Any] = []

    def polish(_fit, *, thorough, stuck):
        asked.append((thorough, stuck))
        return Fit("new", cost)

    made_up_fits(monkeypatch, SimpleNamespace(polish=polish))
    for base_cost, stuck in ((10.0, True), (10.5, False)):
        base: Any = Base(np.ones(2), fit=Fit("base", base_cost))
        candidate: Any = Candidate(Fit("old", 10.0))
        found: Any = polish_candidate(base, candidate, SearchCfg())
        assert (found.fit.name, found.polished) == (name, polished)
        assert asked.pop() == (False, stuck)
    polish_candidate(base, replace(candidate, polished=True), thorough=True)
    assert asked == [(True, False)]


@pytest.mark.parametrize(
    ("together", "by_window", "quick", "begun"),
    [
        (9.0, 9.5, False, "together"), (9.5, 9.0, False, "by window"), (9.5, 9.0, True, "together"),
        (9.91, 9.91, False, None), (9.89, 9.95, False, "together"),
    ],
)  # fmt: skip
def test_a_restart_begins_where_the_cost_falls(monkeypatch, together, by_window, quick, begun):
    starts: list[Any] = []
    solver = SimpleNamespace(
        fit_at_states_of=lambda _leader, _fit: Fit("together", together, "v together"),
        improve_initial_states=lambda _fit, offsets, noise: Fit("by window", by_window, f"v {len(offsets)} {noise}"),
        fit=lambda values, _offsets, _starts: starts.append(values) or Fit("refit", 5.0),
    )
    made_up_fits(monkeypatch, solver)
    base: Any = Base(np.ones(2))
    candidate: Any = Candidate(Fit("old", 10.0))
    leader: Any = Fit("leader")
    found: Any = restart_candidate(base, candidate, leader, SearchCfg(), quick)
    if begun is None:
        assert found is candidate
        assert starts == []
    else:
        assert found.fit.name == "refit"
        assert starts == [{"together": "v together", "by window": "v 1 0.0"}[begun]]


def test_a_candidate_starts_from_a_factor_where_that_gains_more(monkeypatch):
    tried: list[Any] = []
    solver = SimpleNamespace(
        p=SimpleNamespace(start=np.array([7.0, 0.5]), split=[slice(0, 1), slice(1, 2)]),
        inside=lambda v: np.minimum(v, 0.9),
    )
    monkeypatch.setattr(gradient_start, "candidate_solver", lambda *_: solver)
    left = {0.5: 6.0, 0.0: 5.0}

    def residuals(_solver, _base, values, offsets):
        tried.append((values.tolist(), offsets[0].tolist()))
        return [np.array([left[float(offsets[0][0])]])]

    monkeypatch.setattr(gradient_start, "projected_residuals", residuals)
    monkeypatch.setattr(gradient_start, "robust_sum", lambda _base, rs: float(sum(r.sum() for r in rs)))
    base: Any = Base(np.ones(2), pieces=(SimpleNamespace(residual=np.array([10.0])),))

    @dataclass(frozen=True)
    class Screened:
        effect: Any
        scanned_gain: float
        start: Any = None
        measured: bool = False

    mass = SimpleNamespace(name="mass", target=("box",))
    for gain, expected in ((0.3, (0.5, True)), (0.45, (0.5, True)), (0.5, (0.5, False))):
        found: Any = start_from_factor(base, Screened(mass, gain), 3.0)  # pyright: ignore[reportArgumentType]
        assert (found.scanned_gain, found.measured) == expected
    assert tried[:2] == [([0.9, 0.9], [0.5]), ([0.9, 0.9], [0.0])]
    assert solver.p.start.tolist() == [7.0, 0.5]
    left[0.0] = 6.5
    found = start_from_factor(base, Screened(mass, 0.3), 1.2)  # pyright: ignore[reportArgumentType]
    assert (found.scanned_gain, found.measured) == (pytest.approx(0.4), False)
    np.testing.assert_allclose(found.start, [0.9, 0.6])


def test_points_of_a_profile_stay_within_bounds_and_go_on_where_the_cost_rises_little(monkeypatch):
    monkeypatch.setattr(profile_likelihood, "covariance", lambda *_: np.diag([1.0, 0.25, 1.0]))
    parameters = (
        Parameter("own", "-", 0.0, 0.0, 9.0, 1.0),
        Parameter("a", "-", 0.0, -1.0, 9.0, 0.5),
        Parameter("b", "-", 0.0, 0.0, 9.0, 1.0),
    )
    base: Any = Base(np.ones(2), made=SimpleNamespace(p=SimpleNamespace(owned=1, parameters=parameters)))
    c: Any = SimpleNamespace(effect=ANY, sums=ANY, fit=SimpleNamespace(values=np.array([1.0, 0.0, np.inf]), cost=10.0))
    cfg = ProfileLikelihoodCfg()
    assert _next_distances(base, c, [], cfg) == [(1, -2.0), (1, 2.0)]

    def point(distance: float, cost: float) -> Any:
        return SimpleNamespace(parameter=1, distance=distance, cost=cost, expected_rise=1.0, overdispersion=1.0)

    assert _next_distances(base, c, [point(-2.0, 10.5), point(2.0, 10.5)], cfg) == [(1, 6.0)]  # -6 is below the bound
    assert _next_distances(base, c, [point(-2.0, 11.0), point(2.0, 9.0)], cfg) == [(1, 6.0)]
    rounds: list[Any] = []
    for costs, count in (([10.5] * 20, 4), ([10.5, 8.9, 10.5], 2), ([8.9], 1)):
        left = iter(costs)
        monkeypatch.setattr(
            profile_likelihood, "_next_distances", lambda _b, _c, points, _cfg: [(1, 2.0 + len(points))]
        )
        monkeypatch.setattr(profile_likelihood, "profile_point", lambda *_, left=left: point(2.0, next(left)))
        found = _profile(base, c, TaskRunner(), cfg, restarts=True)
        rounds.append(len(found))
        assert len(found) == count
    monkeypatch.setattr(profile_likelihood, "_next_distances", lambda *_: [])
    assert _profile(base, c, TaskRunner(), cfg, restarts=True) == []
    assert rounds == [4, 2, 1]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({}, ""),
        ({"p": 0.051}, "no better than chance"),
        ({"p": 0.05}, ""),
        ({"share": 0.049}, "removes less than 5 % of the error"),
        ({"share": 0.05}, ""),
        ({"low": 0.0}, "the interval of its gain includes zero"),
        ({"low": -0.1}, "the interval of its gain includes zero"),
        ({"folds": (1, 1, 1, -1, -1)}, "folds disagree"),
        ({"folds": (1, 1, 1, 1, 0)}, ""),
        ({"excludes": (False, False)}, "its parameters may be at their null values"),
        ({"bounds": (False, True)}, "a parameter is at its bound"),
        ({"excludes": (True, False)}, ""),
        ({"excludes": (False, False), "together": True}, ""),
    ],
)
def test_an_effect_is_accepted_unless_there_is_a_reason_against_it(monkeypatch, changes, reason):
    values: dict[str, Any] = {
        "p": 0.01,
        "share": 0.5,
        "low": 0.1,
        "folds": (1,) * 5,
        "excludes": (True, True),
        "bounds": (False,) * 2,
        "together": False,
    }
    values |= changes
    parameters = tuple(
        SimpleNamespace(excludes_null=e, at_bound=b) for e, b in zip(values["excludes"], values["bounds"], strict=True)
    )
    monkeypatch.setattr(evidence, "bootstrap_interval", lambda *_: (values["low"], 0.9))
    monkeypatch.setattr(evidence, "fitted_parameters", lambda *_: parameters)
    monkeypatch.setattr(evidence, "fitted_covariance", lambda *_: np.eye(2))
    together = values["together"]
    monkeypatch.setattr(evidence, "excludes_null", lambda each, *_: together or any(q.excludes_null for q in each))
    monkeypatch.setattr(evidence, "removed_by_channel", lambda *_: (("angle", 0.5),))
    monkeypatch.setattr(evidence, "sign_flip_p", lambda *_: 0.02)
    monkeypatch.setattr(evidence, "null_p_value", lambda _null, gain: 0.001 if np.isinf(gain) else values["p"])
    gain = np.repeat(np.array(values["folds"], float), 2)
    blocks = SimpleNamespace(fold=np.repeat(np.arange(5), 2), demonstration=np.zeros(10))
    base: Any = Base(np.ones(10), blocks=blocks)
    effect = SimpleNamespace(name="mass", target=("box",), family="objects")
    candidate: Any = SimpleNamespace(effect=effect, share=lambda _base: values["share"], gain=lambda _base: gain)
    found = evidence.assess(base, candidate, np.zeros(3), 2, [ANY, candidate.effect][1:], DiagnoseCfg())
    assert (found.reason, found.accepted) == (reason, not reason)
    assert (found.name, found.target, found.family, found.step) == ("mass", ("box",), "objects", 2)
    assert (found.gain, found.low, found.high) == (values["share"], values["low"], 0.9)
    assert (found.p, found.sign_p, found.smallest_p) == (values["p"], 0.02, 0.001)
    assert (found.parameters, found.removes) == (parameters, (("angle", 0.5),))


def test_models_are_compared_by_the_robust_loss_of_the_simpler_one(monkeypatch):
    monkeypatch.setattr(baseline, "block_sums", lambda _pieces, _blocks, limit: limit)
    monkeypatch.setattr(baseline, "held_out_errors", lambda _model, limit, _blocks, _prior: np.array([limit]))

    def fitted(residual: list[float], limit: float) -> Any:
        own = huber_limit([np.array(residual)])
        cost = 3.0 + huber(np.array(residual), own).sum()
        fit = SimpleNamespace(linear=[SimpleNamespace(residual=np.array(residual))], cost=cost)
        return SimpleNamespace(
            fit=fit, limit=limit, cfg=SETTINGS, errors=np.array([-limit]), pieces=(), blocks=None, model=None
        )

    simple, other = fitted([2.0, 2.0, 2.0, 30.0], 11.0), fitted([1.0, 1.0, 1.0, 30.0], 5.0)
    assert baseline.errors_like(other, simple).tolist() == [11.0]
    assert baseline.errors_like(simple, simple).tolist() == [-11.0]
    wide = huber_limit([np.array([2.0, 2.0, 2.0, 30.0])])
    assert baseline.cost_like(other, simple) == pytest.approx(3.0 + 3 * 0.5 + huber(np.array([30.0]), wide).sum())
    assert baseline.cost_like(other, other) == other.fit.cost
