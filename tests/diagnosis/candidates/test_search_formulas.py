"""Numbers of the search against their formulas: evidence, screening, null distribution, forces of no known form."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import mujoco
import numpy as np
import pytest

from concent_warp.diagnosis.candidates import evidence, screening
from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel, ScreenedCandidate
from concent_warp.diagnosis.candidates.candidates import has_effect, label
from concent_warp.diagnosis.candidates.evidence import (
    _log_errors,
    _plausibility,
    detectable_size,
    fitted_parameters,
    indistinguishable,
    removed_by_channel,
    surprise,
)
from concent_warp.diagnosis.candidates.null_distribution import max_gain_under_null, null_p_value
from concent_warp.diagnosis.candidates.screening import _linear_gain, _scan, projected_residuals, robust_sum
from concent_warp.diagnosis.cfg import DiagnoseCfg, SearchCfg, UnknownForceCfg
from concent_warp.diagnosis.search import unknown_force as module
from concent_warp.diagnosis.search.unknown_force import (
    _best_force,
    _body_forces,
    _listed,
    _spread_out,
    _with_prior,
    combined,
    unknown_force,
    with_interleaved_folds,
)
from concent_warp.effects.effect import Parameter
from concent_warp.effects.unknown_force import UnknownBodyForce, UnknownForce
from concent_warp.fit.effects.cross_validation import Blocks, HeldOut, block_sums
from concent_warp.fit.effects.least_squares import Linear

ANY: Any = None
LIMIT = 2.0
ROWS, COUNT = 40, 8


def blocks() -> Blocks:
    """Return blocks of two windows, in four folds."""
    of_row = np.repeat(np.arange(4), ROWS // 4), 4 + np.repeat(np.arange(4), ROWS // 4)
    place = np.arange(COUNT, dtype=float)
    return Blocks(of_row, np.arange(COUNT) % 4, np.zeros(COUNT, int), place, place + 1)


def pieces(seed: int, parameters: int) -> tuple[Linear, ...]:
    """Return random residuals and sensitivities of two windows."""
    rng = np.random.default_rng(seed)
    return tuple(Linear(1.5 * rng.normal(size=ROWS), rng.normal(size=(ROWS, parameters))) for _ in range(2))


class MadeUpModel(FittedModel):
    """A fitted model whose candidates have the parameters of `OneEffect`."""

    def prediction(self, *_: Any, **__: Any) -> Any:
        """Return the parameters."""
        return OneEffect()


def base_of(owned: int = 1, **changes: Any) -> Any:
    """Return a fitted model with random residuals."""
    own = pieces(0, owned)
    bare = cast("Any", SimpleNamespace(effects=()))
    windows = (cast("Any", SimpleNamespace(noise_scale=1.0)),)
    made = MadeUpModel(bare, windows, blocks(), ANY, own, LIMIT, np.zeros(COUNT))
    return replace(made, **{"errors": made.held_out(own).own(), **changes})


def weights(residual: np.ndarray) -> np.ndarray:
    """Return Huber's weights."""
    return np.minimum(1, LIMIT / np.abs(residual))


def test_the_null_distribution_is_that_of_sign_flipped_blocks():
    base, seed, samples = base_of(), 3, 20
    screened = [screened_of(1, 3), screened_of(2, 2)]
    found = max_gain_under_null(base, screened, samples, seed)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=(samples, COUNT))
    rows = np.concatenate(base.blocks.of_row)
    residual = np.concatenate([p.residual for p in base.pieces])
    weight = np.sqrt(weights(residual))

    def error(parts, sign, own):
        """Return the held-out error of flipped residuals, fold by fold."""
        j = np.concatenate([p.jacobian for p in parts])
        w = np.sqrt(weights(np.concatenate([p.residual for p in parts])))[:, None]
        r = np.concatenate([p.residual for p in parts]) * sign[rows]
        total = 0.0
        for fold in range(4):
            out = base.blocks.fold[rows] == fold
            a, b = (w * j)[~out], (w[:, 0] * r)[~out]
            delta = -np.linalg.solve(a.T @ a + np.eye(j.shape[1]) / 100, a.T @ b)
            total += ((own * r)[out] ** 2).sum() + 2 * delta @ (w * j)[out].T @ (w[:, 0] * r)[out]
            total += delta @ (w * j)[out].T @ (w * j)[out] @ delta
        return total

    for k in range(samples):
        before = error(base.pieces, signs[k], weight)
        gains = [(before - error(s.pieces, signs[k], weight)) / before for s in screened]
        assert found[k] == pytest.approx(max(gains), rel=1e-9)
    assert null_p_value(np.array([0.1, 0.2, 0.3]), 0.2) == 0.75
    assert null_p_value(np.array([0.1, 0.2, 0.3]), 0.4) == 0.25


def screened_of(seed: int, parameters: int, effect: Any = None, owned: int = 1) -> Any:
    """Return a screened candidate with the baseline's residuals and random sensitivities."""
    parts = tuple(
        replace(p, jacobian=np.hstack([p.jacobian, q.jacobian]))
        for p, q in zip(pieces(0, owned), pieces(seed, parameters), strict=True)
    )
    return ScreenedCandidate(effect, 0.1, 0.0, np.zeros(owned + parameters), parts)


def test_the_gain_of_a_linear_step_is_the_fall_of_the_held_out_error():
    base, s = base_of(), screened_of(1, 2)
    after = HeldOut(block_sums(s.pieces, base.blocks, LIMIT), base.blocks, 10.0).own().sum()
    before = base.errors.sum()
    assert _linear_gain(base, s.pieces, base.pieces, base.errors) == pytest.approx((before - after) / before)
    assert (s.expected_gain, replace(s, scanned_gain=0.3).expected_gain) == (0.1, 0.3)


def test_projected_residuals_are_without_what_the_initial_states_take_up():
    rng = np.random.default_rng(4)
    starts = [rng.normal(size=(ROWS, 2)) for _ in range(2)]
    residuals = [rng.normal(size=ROWS) for _ in range(2)]
    offsets = [np.array([0.5, -3.0]), np.array([0.0, 1.0])]
    base = base_of(fit=SimpleNamespace(starts=starts, offsets=offsets))
    solver: Any = SimpleNamespace(
        p=SimpleNamespace(residuals=lambda _trials: residuals), trials=lambda values, o: (values, o)
    )
    found = projected_residuals(solver, base, ANY, offsets)
    for r, a, o, left in zip(residuals, starts, offsets, found, strict=True):
        near = np.diag(1 / (1 + (o / 2) ** 2))
        step = np.linalg.solve(a.T @ a + near, a.T @ r + near @ o)
        np.testing.assert_allclose(left, r - a @ step)
    expected = sum(np.where(np.abs(r) <= 2, r**2, 4 * (np.abs(r) - 1)).sum() for r in residuals)
    assert robust_sum(base, residuals) == pytest.approx(expected)


OFFSETS = (np.zeros(2),)
"""Errors of the initial states."""


def scanning(monkeypatch, parameters, share):
    """Return what `_scan` finds, and the values and windows that it simulates.

    Args:
        monkeypatch: Replaces residuals.
        parameters: Those of the model and of the candidate; the first is the model's own.
        share: Returns the share of each window's squared residual that values leave.
    """
    high = np.array([p.high for p in parameters])
    solver: Any = SimpleNamespace(p=SimpleNamespace(parameters=parameters, owned=1), high=high)
    base, tried = base_of(), []
    before = [robust_sum(base, [p.residual]) for p in base.pieces]
    reduced = tuple(replace(p, residual=np.full(1, np.sqrt(b))) for p, b in zip(base.pieces, before, strict=True))

    def residuals(_solver, _base, values, offsets, windows):
        assert offsets is OFFSETS
        tried.append((values.tolist(), list(windows)))
        return [np.full(1, np.sqrt(share(values) * before[w])) for w in windows]

    monkeypatch.setattr(screening, "robust_sum", lambda _base, rs: sum(float(r @ r) for r in rs))
    monkeypatch.setattr(screening, "projected_residuals", residuals)
    gain, start = _scan(
        solver, replace(base, pieces=reduced), np.array([0.5, *(p.null for p in parameters[1:])]), OFFSETS, SearchCfg()
    )
    return gain, start.tolist(), tried, before


OWN = Parameter("own", "-", 0.0, 0.0, 9.0, 1.0, scan=(5.0,))


def test_scanned_values_are_tried_one_at_a_time_and_the_best_starts_the_fit(monkeypatch):
    parameters = [
        OWN,
        Parameter("a", "-", 0.0, 0.0, 9.0, 1.0, scan=(1.0, 2.0)),
        Parameter("b", "-", np.inf, 0.0, 8.0, 1.0, scan=(3.0,)),
    ]
    left = {1.0: 0.9, 2.0: 0.6}
    gain, start, tried, before = scanning(monkeypatch, parameters, lambda values: left.get(values[1], 0.8))
    largest = int(np.argmax(before))
    in_turn = [[0.5, 1.0, np.inf], [0.5, 2.0, np.inf], [0.5, 0.0, 3.0]]
    assert [values for values, windows in tried if largest in windows] == in_turn
    for values in in_turn:
        assert sorted(w for other, windows in tried if other == values for w in windows) == list(range(len(before)))
    assert gain == pytest.approx(0.4)
    assert start == [0.5, 2.0, np.inf]
    gain, start, tried, _ = scanning(monkeypatch, parameters, lambda _: 1.1)
    assert gain == 0.0
    assert start == [0.5, 0.0, 8.0]
    # What gains nothing in the windows with the largest residuals is simulated in no others.
    assert [values for values, _ in tried] == in_turn
    assert scanning(monkeypatch, [OWN], lambda _: 0.5)[:3] == (0.0, [0.5], [])


def test_scanned_values_beyond_one_that_is_far_worse_are_not_tried(monkeypatch):
    parameters = [OWN, Parameter("a", "-", 3.0, 0.0, 9.0, 1.0, scan=(9.0, 1.0, 4.0, 2.0, 5.0, 0.0))]
    left = {2.0: 1.2, 1.0: 1.9, 4.0: 1.2, 5.0: 0.7, 9.0: 1.3}
    gain, start, tried, _ = scanning(monkeypatch, parameters, lambda values: left[values[1]])
    assert list(dict.fromkeys(values[1] for values, _ in tried)) == [2.0, 1.0, 4.0, 5.0, 9.0]
    assert (gain, start) == (pytest.approx(0.3), [0.5, 5.0])
    # Where all leave more than the model at its own initial states, as long as one is no worse than an earlier one.
    _, _, tried, _ = scanning(monkeypatch, parameters, lambda values: 3.0 - 0.1 * abs(values[1] - 3.0))
    assert [values[1] for values, _ in tried] == [2.0, 1.0, 0.0, 4.0, 5.0, 9.0]


class OneEffect:
    """Stands in for the prediction of a model with a candidate."""

    owned = 1
    parameters = (
        Parameter("own", "-", 0.0, 0.0, 1.0, 1.0),
        Parameter("a", "N", 1.0, -50.0, 50.0, 2.0),
        Parameter("b", "m", 0.0, -1.0, 1.0, 0.5),
        Parameter("c", "-", np.inf, 0.0, 90.0, 3.0),
    )

    def __init__(self, *_: Any, **__: Any) -> None:
        pass


def fitted(errors: np.ndarray, **changes: Any) -> Any:
    """Return a fitted candidate with held-out errors."""
    rarity = changes.pop("rarity", 0.0)
    effect = SimpleNamespace(rarity=rarity, special_cases=(), name="mass", target=("x",), family="objects")
    values = np.array([0.3, 1.7, -0.2, 5.0])
    base = FittedCandidate(
        cast("Any", effect),
        ANY,
        cast("Any", SimpleNamespace(values=values)),
        ANY,
        pieces(0, 1),
        errors,
        1.0,
        std=np.full(4, 0.1),  # pyright: ignore
    )
    return replace(base, **changes)


def test_a_size_is_no_surprise_below_what_is_typical():
    effect: Any = SimpleNamespace(rarity=0.0)
    for typical, unit in ((0.0, 0.3), (0.1, 0.3), (2.0, 2.0)):
        sizes = [Parameter("a", "-", 1.0, 0.0, 9.0, 0.3, typical=typical)]
        assert surprise(effect, sizes, [1.0], 1) == 0
        assert surprise(effect, sizes, [1.0 + unit], 1) == pytest.approx(2 * np.log(2))
        assert surprise(effect, 3 * sizes, 3 * [1.0], 10) == pytest.approx(3 * np.log(10))
    rare: Any = SimpleNamespace(rarity=6.0)
    assert surprise(rare, [Parameter("a", "-", np.inf, 0.0, 9.0, 0.3)], [5.0], 1) == 6


def test_plausibility_is_schwarzs_criterion_with_a_cauchy_prior():
    base = base_of()
    c = fitted(np.full(COUNT, 0.5), rarity=4.0)
    values: Any = [SimpleNamespace(value=v, null=n) for v, n in ((2.0, 1.0), (-0.2, 0.0), (5.0, np.inf))]
    found = _plausibility(base, c, SimpleNamespace(parameters=values))  # pyright: ignore[reportArgumentType]
    away = np.array([0.5, -0.4, 0.0])
    expected = -COUNT * np.log(4.0) - 3 * np.log(COUNT) - 2 * np.log(1 + away**2).sum() - 4.0
    assert found == pytest.approx(expected)
    assert _log_errors(base, c) == pytest.approx(COUNT * np.log(4.0))


def test_intervals_of_parameters_end_at_their_bounds(monkeypatch):
    monkeypatch.setattr(evidence, "formula_errors", lambda *_: np.array([0.3, 0.0, 0.0]))
    base = base_of()
    found = {p.name: p for p in fitted_parameters(base, fitted(np.ones(COUNT)))}
    assert list(found) == ["a", "b", "c"]
    reach = 1.96 * np.hypot(0.2, 0.3)
    assert (found["a"].low, found["a"].high) == pytest.approx((1.7 - reach, 1.7 + reach))
    assert (found["b"].low, found["b"].high) == pytest.approx((-0.2 - 0.098, -0.2 + 0.098))
    assert (found["a"].unit, found["a"].null, found["a"].value) == ("N", 1.0, 1.7)
    assert not any(p.at_bound for p in found.values())
    wide = fitted_parameters(base, fitted(np.ones(COUNT), std=np.full(4, 99.0)))
    assert [(p.low, p.high) for p in wide] == [(-50, 50), (-1, 1), (0, 90)]
    for value, ended in ((-1 + 4e-4, True), (-1 + 6e-4, False), (1 - 4e-4, True)):
        fit = SimpleNamespace(values=np.array([0.3, 1.7, value, 5.0]))
        assert fitted_parameters(base, fitted(np.ones(COUNT), fit=fit))[1].at_bound == ended


def test_groups_hold_those_within_errors_of_the_difference(monkeypatch):
    base = base_of()
    monkeypatch.setattr(evidence, "_plausibility", lambda _b, c, _f: c.ratio)
    rng = np.random.default_rng(6)
    errors = 1 + 0.3 * rng.random(COUNT)
    step = 0.2 * rng.normal(size=COUNT)
    bound = 2 * np.sqrt(COUNT) * step.std()
    best = fitted(errors, ratio=1.0)

    def grouped(shift, slack=1.0, **changes):
        other = fitted(errors + step - step.mean() + shift / COUNT, **changes)
        pairs: Any = [(other, SimpleNamespace(gain=0.1)), (best, SimpleNamespace(gain=0.5))]
        return [c is best for c, _ in indistinguishable(base, pairs, SearchCfg(), slack)]

    assert grouped(0.999 * bound, ratio=2.0) == [False, True]
    assert grouped(0.999 * bound, ratio=0.5) == [True, False]
    assert grouped(1.001 * bound, ratio=2.0) == [True]
    assert grouped(1.2 * bound, 1.25, ratio=2.0) == [False, True]
    assert grouped(1.001 * np.hypot(bound, 2 * 2 * 0.4), ratio=2.0, cost_roughness=0.4) == [True]
    assert grouped(0.999 * np.hypot(bound, 2 * 2 * 0.4), ratio=2.0, cost_roughness=0.4) == [False, True]
    step = step * 0
    share = 0.02 * errors.sum()
    assert grouped(0.999 * share, ratio=2.0) == [False, True]
    assert grouped(1.001 * share, ratio=2.0) == [True]


def test_removed_shares_are_those_of_each_channel_largest_first():
    rows = [SimpleNamespace(channel=n, rows=slice(10 * k, 10 * k + 10)) for k, n in enumerate("abcd")]
    base, c = base_of(windows=(SimpleNamespace(readings=rows),) * 2), fitted(np.ones(COUNT))
    factors = np.repeat([0.9, 0.5, 1.0, 1.1], 10)
    parts = tuple(replace(p, residual=p.residual * factors) for p in base.pieces)
    assert removed_by_channel(base, replace(c, pieces=parts)) == (
        ("b", pytest.approx(0.75)), ("a", pytest.approx(0.19)),
    )  # fmt: skip


def test_the_smallest_detectable_size_is_of_the_most_sensitive_parameter():
    base, s = base_of(), screened_of(1, 3, SimpleNamespace(name="mass"))
    found = detectable_size(base, s, 0.1)
    assert found is not None
    square = np.sum([(p.jacobian**2).sum(axis=0) for p in s.pieces], axis=0)
    sizes = np.sqrt(0.1 * base.errors.sum() / square[1:3])
    best = int(np.argmin(sizes))
    assert (found.name, found.parameter, found.unit) == ("mass", "ab"[best], ["N", "m"][best])
    assert found.size == pytest.approx(sizes[best] * [2.0, 0.5][best])
    assert detectable_size(base, s, -1.0).size == 0  # pyright: ignore[reportOptionalMemberAccess]
    far = base.errors.sum() * 1e9
    assert detectable_size(base_of(errors=np.array([far])), s, 1.0) is None


def test_labels_have_targets_where_names_are_shared():
    def effect(name: str, *target: str) -> Any:
        return SimpleNamespace(name=name, target=target, elements=target)

    one, two, three = effect("a", "x"), effect("a", "x", "y"), effect("b", "x")
    assert [label(e, [one, two, three]) for e in (one, two, three)] == ["a(x)", "a(x, ...)", "b"]
    model: Any = SimpleNamespace(effects=[SimpleNamespace(effect=one)])
    others = (one, two, three, effect("a", "z"), effect("a"))
    assert [has_effect(model, e) for e in others] == [True, True, False, False, True]


def test_folds_of_forces_are_dealt_in_turn():
    base = base_of(blocks=replace(blocks(), fold=np.zeros(COUNT, int)))
    found = with_interleaved_folds(base)
    assert found.blocks.fold.tolist() == [0, 1, 2, 3, 4, 0, 1, 2]
    expected = HeldOut(block_sums(base.pieces, found.blocks, LIMIT), found.blocks, 10.0).own()
    np.testing.assert_allclose(found.errors, expected)


def test_priors_of_forces_expect_the_same_of_each_basis_function():
    base, s = base_of(), screened_of(1, 4)
    parts = [replace(p, jacobian=p.jacobian * np.array([1, 1, 1e-6, 1, 1])) for p in s.pieces]
    found = _with_prior(base, replace(s, pieces=tuple(parts)), 0.3)
    square = np.sum([(p.jacobian**2).sum(axis=0) for p in found.pieces], axis=0)
    each = 0.3 * base.errors.sum() / 3 / 100
    np.testing.assert_allclose(square[1:], [each, 0, each, each])
    for p, q in zip(found.pieces, parts, strict=True):
        np.testing.assert_array_equal(p.jacobian[:, 0], q.jacobian[:, 0])
    both = combined(base, [s, screened_of(2, 2)], 0.3)
    assert both.pieces[0].jacobian.shape == (ROWS, 1 + 4 + 2)
    square = np.sum([(p.jacobian**2).sum(axis=0) for p in both.pieces], axis=0)
    half = 0.15 * base.errors.sum() / 100
    np.testing.assert_allclose(square[1:], [*[half / 4] * 4, *[half / 2] * 2])
    np.testing.assert_array_equal(both.pieces[1].jacobian[:, 0], s.pieces[1].jacobian[:, 0])


def test_points_are_spread_out_from_their_middle():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [3, 4, 0], [0.5, 0, 0], [1, 0.2, 0]])
    chosen, width = _spread_out(points, 3)
    np.testing.assert_array_equal(chosen, [[1, 0, 0], [3, 4, 0], [3, 0, 0]])
    assert width == pytest.approx(2.0)
    same, none = _spread_out(np.ones((5, 3)), 4)
    assert same.tolist() == [[1, 1, 1]]
    assert none < 1e-4
    every, _ = _spread_out(points, 20)
    assert len(every) == 6


BALL = """<mujoco><option gravity="0 0 -5"/><worldbody><body name="pole"><joint name="turn"/><geom size=".1"/></body>
  <body name="ball"><freejoint/><geom size=".1" mass="2"/>
    <body><joint name="x"/><geom size=".1" mass="1"/></body></body></worldbody></mujoco>"""


def test_forces_on_a_body_cover_where_it_was_and_how_fast():
    m, rng, cfg = mujoco.MjModel.from_xml_string(BALL), np.random.default_rng(0), UnknownForceCfg()
    qpos, qvel = rng.normal(size=(200, m.nq)), rng.normal(size=(200, m.nv))
    body = m.body("ball").id
    found: Any = _body_forces(m, body, qpos, qvel, cfg)
    assert [f.words for f in found] == [
        "a force that depends on the position of ball", "a resistance that depends on the position of ball",
        "a resistance that depends on the speed of ball", "a resistance that depends on the rate of turning of ball",
    ]  # fmt: skip
    models = [f.force_model(m) for f in found]
    assert [f.way for f in models] == ["field", "brake", "drag", "turning"]
    assert {(f.body, f.place, f.dof) for f in models} == {(body, 1, 1)}
    force = 0.1 * 3 * 5
    assert [f.scale for f in models] == pytest.approx([force, force, force, 0.05 * force])
    centre, width = _spread_out(qpos[:, 1:4], 12)
    for f in models[:2]:
        np.testing.assert_array_equal(f.centre, centre)
        assert f.width == width
    for f, values in zip(models[2:], (qvel[:, 1:4], qvel[:, 4:7]), strict=True):
        high = np.percentile(np.linalg.norm(values, axis=1), 99.5)
        np.testing.assert_allclose(f.centre[:, 0], np.linspace(0, high, 5))
        assert f.width == pytest.approx(high / 4)
    still = _body_forces(m, body, np.ones((9, m.nq)), 0 * qvel[:9], cfg)
    assert still == []
    slow = 0 * qvel[:9]
    slow[:, 4] = 0.1
    turning: Any = _body_forces(m, body, np.ones((9, m.nq)), slow, cfg)
    assert [f.force_model(m).way for f in turning] == ["turning"]
    weightless = mujoco.MjModel.from_xml_string(BALL.replace("0 0 -5", "0 0 -.5"))
    light: Any = _body_forces(weightless, body, qpos, qvel, cfg)
    assert light[0].force_model(m).scale == pytest.approx(0.3)
    assert _listed(m, np.array([0])) == "turn"
    assert _listed(m, np.array([0, 2])) == "each of 2 joints"


class Node(SimpleNamespace):
    """A fitted model of some noise ratio and number of effects."""


def chain(*ratios: float, engines: tuple[str, ...] = ("mujoco", "warp"), counts: Any = None) -> list[Any]:
    """Return fitted models after each addition."""
    added = SimpleNamespace(effect=SimpleNamespace(engines=engines))
    counts = range(len(ratios)) if counts is None else counts
    return [Node(ratio=r, model=SimpleNamespace(effects=[added] * k)) for r, k in zip(ratios, counts, strict=True)]


def test_forces_are_tested_on_the_last_model_and_against_the_effects_added_before(monkeypatch):
    cfg, asked = DiagnoseCfg(), []

    def best(base, rival, lacked, *_):
        asked.append((base.ratio, None if rival is None else rival.ratio, lacked))
        return answers.pop(0) if answers else None

    monkeypatch.setattr(module, "_best_force", best)
    monkeypatch.setattr(module, "discrepancies", lambda *both: tuple(one.ratio**2 - 1 for one in both))
    answers: list[Any] = []
    nodes = chain(3.0, 2.0, 1.5, 1.1)
    assert unknown_force(nodes, cfg, ANY) is None
    assert asked == [(1.1, None, 8.0), (1.5, 1.1, 8.0), (2.0, 1.5, 8.0)]
    asked.clear()
    large, small = SimpleNamespace(form_error=False), SimpleNamespace(form_error=True)
    for given, expected, count in (
        ([large], large, 1),
        ([None, large], large, 2),
        ([small, large], large, 2),
        ([small, None, None], small, 3),
        ([small, small, small], small, 3),
        ([None, small, small], None, 3),
    ):
        asked.clear()
        answers[:] = given
        assert unknown_force(nodes, cfg, ANY) is expected
        assert len(asked) == count
    asked.clear()
    unknown_force(chain(1.01), cfg, ANY)
    assert asked == []
    for ratios in ((1.015,), (1.0, 1.2)):
        asked.clear()
        unknown_force(chain(*ratios), cfg, ANY)
        assert asked[0] == (ratios[-1], None, pytest.approx(max(ratios[-1] ** 2 - 1, 0.03)))
    asked.clear()
    unknown_force(chain(1.0, 1.01, 1.0), cfg, ANY)
    assert asked == [(1.01, 1.0, 0.03)]
    asked.clear()
    assert unknown_force(chain(3.0, 1.2, engines=("warp",)), cfg, ANY) is None
    assert asked == []
    unknown_force(chain(3.0, 1.2, 1.1, counts=(0, 2, 1)), cfg, ANY)
    assert asked == [(1.1, None, 8.0)]


def test_the_best_force_must_be_large_and_significant(monkeypatch):
    model = base_of()
    force = UnknownForce("a force", UnknownBodyForce(1, 0, 0, np.zeros((1, 3)), 1.0, 1.0, "brake"))
    other = UnknownForce("another", UnknownBodyForce(1, 0, 0, np.zeros((1, 3)), 1.0, 1.0, "brake"))
    parts = tuple(
        replace(p, jacobian=np.hstack([p.jacobian, (p.residual + 0.2 * q.residual)[:, None]]))
        for p, q in zip(model.pieces, pieces(7, 1), strict=True)
    )
    explains = ScreenedCandidate(force, 0.1, 0.0, np.zeros(2), parts)
    useless = replace(screened_of(9, 1, other))
    monkeypatch.setattr(module, "forces", lambda *_: [other, force])
    cfg = DiagnoseCfg()

    def results(_task, tasks):
        assert len(tasks) == 2
        return [useless, explains]

    found = _best_force(model, None, 1.0, cfg, results)
    assert found is not None
    assert found.words == "a force"
    assert found.instead is None
    again = with_interleaved_folds(replace(model, engine="mujoco"))
    tried = [_with_prior(again, s, x) for s in (useless, explains) for x in (0.02, 0.1, 0.5)]
    tried += [combined(again, [useless, explains], x) for x in (0.02, 0.1, 0.5)]
    errors = [
        HeldOut(block_sums([replace(p, residual=b.residual) for p, b in zip(s.pieces, again.pieces, strict=True)],
                           again.blocks, LIMIT), again.blocks, 10.0).own().sum() for s in tried
    ]  # fmt: skip
    gain = 1 - min(errors) / again.errors.sum()
    assert found.gain == pytest.approx(gain)
    assert found.share == pytest.approx(min(gain * model.ratio**2, 1.0))
    assert found.p == pytest.approx(null_p_value(max_gain_under_null(again, tried, 400, 0), gain))
    half = _best_force(model, None, 4.0, cfg, results)
    assert half is not None
    assert half.share == pytest.approx(gain * model.ratio**2 / 4)
    assert not half.form_error
    tiny = _best_force(model, None, 1e3, cfg, results)
    assert tiny is not None
    assert tiny.form_error
    assert _best_force(model, None, 1.0, replace(cfg, significance_level=1e-9), results) is None
    strict = replace(cfg, unknown_force=replace(cfg.unknown_force, min_gain=gain * 1.01))
    assert _best_force(model, None, 1.0, strict, results) is None
    assert _best_force(model, None, 1.0, cfg, lambda *_: []) is None
    rival = replace(model, pieces=tuple(replace(p, residual=0.9 * p.residual) for p in model.pieces))
    beaten = _best_force(model, rival, 1.0, cfg, results)
    assert beaten is not None
    less = 1 - with_interleaved_folds(rival).errors.sum() / again.errors.sum()
    assert beaten.instead == pytest.approx(less)
    assert beaten.share == pytest.approx(min((gain - less) * model.ratio**2, 1.0))
    assert beaten.p >= found.p
    perfect = replace(model, pieces=tuple(replace(p, residual=0.01 * p.residual) for p in model.pieces))
    assert _best_force(model, perfect, 1.0, cfg, results) is None
