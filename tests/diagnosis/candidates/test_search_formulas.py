"""Numbers of the search against their formulas: evidence, screening, null distribution."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from concent_warp.diagnosis.candidates import evidence, screening
from concent_warp.diagnosis.candidates.candidate import FittedCandidate
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
from concent_warp.diagnosis.cfg import SearchCfg
from concent_warp.effects.effect import Parameter
from concent_warp.fit.effects.cross_validation import HeldOut, block_sums
from tests.diagnosis.candidates.random_models import (
    ANY,
    COUNT,
    LIMIT,
    ROWS,
    base_of,
    pieces,
    screened_of,
)


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


def test_lines_of_values_are_tried_together_each_until_it_gets_far_worse(monkeypatch):
    lines = (((1.0, 2.0), (2.0, 4.0), (3.0, 6.0)), ((4.0, 1.0),))
    parameters = [
        OWN,
        Parameter("a", "-", 0.0, 0.0, 9.0, 1.0, scan_together=lines),
        Parameter("b", "-", 0.0, 0.0, 9.0, 1.0, scan=(5.0,)),
    ]
    left = {1.0: 0.7, 2.0: 1.8, 4.0: 0.9}
    gain, start, tried, _ = scanning(monkeypatch, parameters, lambda values: left.get(values[1], 0.95))
    in_turn = [values[1:] for k, (values, _) in enumerate(tried) if not k or values != tried[k - 1][0]]
    assert in_turn == [[1.0, 2.0], [2.0, 4.0], [4.0, 1.0], [0.0, 5.0]]
    assert gain == pytest.approx(0.3)
    assert start == [0.5, 1.0, 2.0]


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


def test_limits_are_tried_between_scanned_values_too(monkeypatch):
    def share(values):  # it shows between 2.3 and 3.1 only
        return 1 - 0.6 * max(1 - abs(values[1] - 2.7) / 0.4, 0) + 5 * max(2.6 - values[1], 0)

    limit = Parameter("limit", "-", np.inf, 0.0, 8.0, 1.0, scan=(1.0, 2.0, 3.0, 4.0, 5.0))
    gain, start, _, _ = scanning(monkeypatch, [OWN, limit], share)
    assert 1 - share([0.5, 3.0]) < 0.2
    assert start[1] == pytest.approx(2.7, abs=0.1)
    assert gain > 0.45
    assert gain == pytest.approx(1 - share(start))
    # Other parameters are not.
    limit = replace(limit, null=6.0)
    gain, start, _, _ = scanning(monkeypatch, [OWN, limit], share)
    assert start[1] == 3.0


def fitted(errors: np.ndarray, **changes: Any) -> Any:
    """Return a fitted candidate with held-out errors."""
    rarity = changes.pop("rarity", 0.0)
    effect = SimpleNamespace(
        rarity=rarity,
        kind="sensor",
        has_as_special_case=lambda _: False,
        name="mass",
        target=("x",),
        elements=("x",),
        family="objects",
    )
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
    effect: Any = SimpleNamespace(rarity=0.0, kind="joint")
    for typical, unit in ((0.0, 0.3), (0.1, 0.3), (2.0, 2.0)):
        sizes = [Parameter("a", "-", 1.0, 0.0, 9.0, 0.3, typical=typical)]
        assert surprise(effect, sizes, [1.0], 1) == 0
        assert surprise(effect, sizes, [1.0 + unit], 1) == pytest.approx(2 * np.log(2))
        assert surprise(effect, 3 * sizes, 3 * [1.0], 10) == pytest.approx(3 * np.log(10))
    # Joints of a machine are alike: that an effect is large in all of them is one surprise, not one for each.
    joints = [Parameter(f"a[{k}]", "-", 0.0, 0.0, 9.0, 1.0) for k in range(4)]
    other = Parameter("b[0]", "-", 0.0, 0.0, 9.0, 1.0)
    assert surprise(effect, joints, [1.0, -2.0, 0.0, 1.0], 1) == pytest.approx(2 * np.log(5))
    assert surprise(effect, [*joints, other], [1.0, -2.0, 0.0, 1.0, 1.0], 1) == pytest.approx(2 * np.log(5 * 2))
    sensors: Any = SimpleNamespace(rarity=0.0, kind="sensor")
    assert surprise(sensors, joints, [1.0, -2.0, 0.0, 1.0], 1) == pytest.approx(2 * np.log(2 * 5 * 2))
    rare: Any = SimpleNamespace(rarity=6.0, kind="joint")
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
    monkeypatch.setattr(evidence, "formula_errors", lambda *_, **__: np.array([0.3, 0.0, 0.0]))
    monkeypatch.setattr(evidence, "covariance", lambda *_: np.diag([1.0, 4.0, 9.0, 16.0]))
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
    def effect(name: str, *target: str, part: str = "") -> Any:
        of = (*target, part) if part else target
        return SimpleNamespace(name=name, target=of, elements=target, part=part, singles_last=False)

    one, two, three, four = effect("a", "x"), effect("a", "x", "y"), effect("b", "x"), effect("a", "x", "y", part="kp")
    among = [one, two, three, four]
    assert [label(e, among) for e in among] == ["a(x)", "a(x, ...)", "b", "a(x, ..., kp)"]
    model: Any = SimpleNamespace(effects=[SimpleNamespace(effect=one)])
    others = (one, two, three, effect("a", "z"), effect("a"))
    assert [has_effect(model, e) for e in others] == [True, True, False, False, True]
