"""What a fit of effects reports: intervals, remarks, channels, where it starts, on solvers that are written down."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from concent_warp.effects.effect import Parameter
from concent_warp.errors import ModelError
from concent_warp.fit.effects import fit as fitting
from concent_warp.fit.effects.cross_validation import block_sums, cut_blocks
from concent_warp.fit.effects.fit import (
    ChannelError,
    FitEffectsCfg,
    FittedEffects,
    _best_start,
    _by_channel,
    _fitted_parameters,
    _remarks,
    _residuals_at,
    _silent,
    check_finite,
    fit_effects,
)
from concent_warp.fit.effects.initial_states import start_cost, start_step
from concent_warp.fit.effects.intervals import FittedParameter, clustered_std, covariance, discretisation_errors
from concent_warp.fit.effects.least_squares import Fit, LeastSquaresCfg, Linear
from concent_warp.fit.effects.robust import huber_limit, robust_noise_ratio
from tests.fit.effects.test_fit_effects import model_with
from tests.scenes.swinging import swung

NORMAL, HUBER = 1.96, 4.0
CFG = FitEffectsCfg()
PARAMETERS = (
    Parameter("a", "N", 0.0, 0.0, 100.0, 1.0),
    Parameter("b", "m", 0.0, -50.0, 50.0, 0.5),
    Parameter("c", "s", np.inf, 0.0, np.inf, 2.0),
)


def solver_of(parameters: Any = PARAMETERS, split: Any = None, **options: Any) -> Any:
    split = split or [slice(k, k + 1) for k in range(len(parameters))]
    names = [
        SimpleNamespace(name=f"effect_{k}", formula_error=0.0, null_error=0.0, step_error=0.0)
        for k in range(len(split))
    ]
    prediction = SimpleNamespace(parameters=parameters, split=split, effects=names, timestep=1e-3)
    scale = np.array([p.scale for p in parameters])
    high = np.array([p.high for p in parameters])
    return SimpleNamespace(p=prediction, cfg=LeastSquaresCfg(), scale=scale, high=high, **options)


def fit_of(values: Any, *, converged: bool = True) -> Fit:
    return Fit(np.array(values, dtype=float), (), 0.0, (), (), converged, 0.0)


def window(count: int, number: int = 0, **options: Any) -> Any:
    given = {"start": 0.0, "end": 2.0, "clock": np.linspace(0, 2, count), "number": number, "readings": ()} | options
    return SimpleNamespace(**given)


def pieces(strength: tuple[float, ...], seed: int = 0) -> tuple[list[Linear], list[Any]]:
    """Return residuals of noise with sensitivities of some strengths, in two windows."""
    rng = np.random.default_rng(seed)
    linear = [Linear(rng.normal(size=80), rng.normal(size=(80, len(strength))) * strength) for _ in range(2)]
    return linear, [window(80), window(80)]


def test_intervals_combine_the_covariance_and_the_discretisation_error():
    linear, windows = pieces((3.0, 5.0, 2.0))
    values = [4.0, -3.0, 1.5]
    found, correlation, posterior = _fitted_parameters(solver_of(), fit_of(values), linear, windows, CFG)
    blocks = cut_blocks(windows)
    sums = block_sums(linear, blocks, huber_limit([x.residual for x in linear]))
    covered, std = covariance(sums, blocks), clustered_std(sums, blocks)
    np.testing.assert_allclose(correlation, covered / np.sqrt(np.outer(np.diag(covered), np.diag(covered))))
    for k, (p, q) in enumerate(zip(PARAMETERS, found, strict=True)):
        model = discretisation_errors([p], np.array([values[k]]), CFG.discretisation_error)[0]
        reach = NORMAL * np.sqrt((std[k] * p.scale) ** 2 + model**2)
        assert (q.name, q.unit, q.null, q.value) == (p.name, p.unit, p.null, values[k])
        assert q.low == pytest.approx(max(values[k] - reach, p.low))
        assert q.high == pytest.approx(min(values[k] + reach, p.high))
        assert not q.at_bound
        assert np.sqrt(posterior.matrix[k, k]) == pytest.approx(reach / NORMAL)
    data = np.outer(std, std) * correlation
    np.testing.assert_allclose(np.array(posterior.covariance)[0, 1:], data[0, 1:])
    assert posterior.low == tuple(p.low for p in PARAMETERS)


def test_an_effect_of_two_parameters_has_one_discretisation_error_and_one_of_none_has_none():
    linear, windows = pieces((1e6, 1e6, 1e6))
    solver = solver_of(split=[slice(0, 2), slice(2, 2), slice(2, 3)])
    found, *_ = _fitted_parameters(solver, fit_of([40.0, 0.1, 3.0]), linear, windows, CFG)
    largest = 0.005 * 40.0
    assert found[0].high - found[0].value == pytest.approx(NORMAL * largest * 1.0, rel=1e-3)
    assert found[1].high - found[1].value == pytest.approx(NORMAL * largest * 0.5, rel=1e-3)
    assert found[2].high - found[2].value == pytest.approx(NORMAL * 0.005 * 3.0, rel=1e-3)


def test_an_interval_has_the_scatter_of_what_the_formula_leaves_out():
    linear, windows = pieces((1e6, 1e6, 1e6))
    solver = solver_of()
    solver.p.effects[0].formula_error = 0.03
    found, *_ = _fitted_parameters(solver, fit_of([40.0, 2.0, 3.0]), linear, windows, CFG)
    assert found[0].high - found[0].value == pytest.approx(NORMAL * np.hypot(0.03, 0.005) * 40.0, rel=1e-3)
    assert found[1].high - found[1].value == pytest.approx(NORMAL * 0.005 * 2.0, rel=1e-3)


def test_intervals_end_at_the_bounds_and_a_limit_that_is_hardly_determined_has_no_upper_end():
    linear, windows = pieces((1e-3, 1e-3, 1e-3))
    found, *_ = _fitted_parameters(solver_of(), fit_of([4.0, -3.0, 15.0]), linear, windows, CFG)
    width = 10.0 * NORMAL  # of the prior
    assert found[0].low == 0.0
    assert found[0].high == pytest.approx(4 + width, rel=0.01)
    assert found[1].low == pytest.approx(-3 - width / 2, rel=0.01)
    assert found[2].high == np.inf
    linear, windows = pieces((3.0, 3.0, 3.0))
    found, *_ = _fitted_parameters(solver_of(), fit_of([4.0, -3.0, 15.0]), linear, windows, CFG)
    assert found[2].high < 16.0
    narrow = (*PARAMETERS[:2], replace(PARAMETERS[2], high=15.1))
    found, *_ = _fitted_parameters(solver_of(narrow), fit_of([4.0, -3.0, 15.0]), linear, windows, CFG)
    assert found[2].high == np.inf
    wide = FitEffectsCfg(undetermined_share=1e-4)
    found, *_ = _fitted_parameters(solver_of(), fit_of([4.0, -3.0, 15.0]), linear, windows, wide)
    assert found[2].high == np.inf
    assert found[0].high < 5.0


@pytest.mark.parametrize(
    ("value", "null", "low", "high", "at_bound"),
    [
        (0.0, 1.0, 0.0, 9.0, True),
        (9.0, 1.0, 0.0, 9.0, True),
        (0.0, 0.0, 0.0, 9.0, False),
        (5.0, 1.0, 0.0, 9.0, False),
        (9.0, np.inf, 0.0, 9.0, False),
    ],
)
def test_a_parameter_is_at_a_bound_unless_that_is_its_null_value(value, null, low, high, at_bound):
    linear, windows = pieces((3.0,))
    solver = solver_of((Parameter("a", "N", null, low, high, 1.0),))
    ((found,), *_) = _fitted_parameters(solver, fit_of([value]), linear, windows, CFG)
    assert found.at_bound is at_bound
    assert (found.value, found.low >= low, found.high <= high or np.isinf(null)) == (value, True, True)


def fitted(name: str, low: float, high: float, null: float = 0.0, **options: Any) -> FittedParameter:
    return FittedParameter(name, 0.5 * (low + high), low, high, "N", null, **options)


def remarks(*parameters: FittedParameter, correlation: Any = None, converged: bool = True, **options: Any) -> list[str]:
    count = len(parameters)
    given = tuple(Parameter(p.name, "N", p.null, -1e3, 1e3, 1.0) for p in parameters)
    solver = solver_of(options.pop("priors", given), **options)
    correlation = np.eye(count) if correlation is None else np.array(correlation)
    return _remarks(solver, fit_of([0.0] * count, converged=converged), parameters, correlation, CFG)


def test_a_fit_without_doubts_has_no_remarks():
    assert remarks(fitted("a", 1.0, 2.0), fitted("b", -2.0, -1.0)) == []


def test_what_has_not_converged_is_remarked():
    assert remarks(fitted("a", 1.0, 2.0), converged=False) == [
        "The fit has not converged: take its values with care, or start from better ones."
    ]


def test_a_bound_is_remarked_with_its_value_and_unit():
    (found,) = remarks(fitted("a", 1.0, 2.0, at_bound=True))
    assert found == "a ended on its bound, 1.5 N: what is missing may be something else."


def test_what_the_recording_hardly_determines_is_remarked_by_prior_or_by_bounds():
    most = 2 * NORMAL * 0.5 * 10.0  # half the prior of scale 1
    assert remarks(fitted("a", 1.0, 1.0 + 0.999 * most)) == []
    assert remarks(fitted("a", 1.0, 1.0 + 1.001 * most)) == ["The recording hardly determines a."]
    wider = (Parameter("a", "N", 0.0, -1e3, 1e3, 2.0),)
    assert remarks(fitted("a", 1.0, 1.0 + 1.999 * most), priors=wider) == []
    assert remarks(fitted("a", 1.0, 1.0 + 2.001 * most), priors=wider) == ["The recording hardly determines a."]
    narrow = (Parameter("a", "N", 0.0, 0.0, 4.0, 1.0),)
    assert remarks(fitted("a", 0.03, 4.0), priors=narrow) == ["The recording hardly determines a."]
    assert remarks(fitted("a", 0.05, 4.0), priors=narrow) == []
    assert remarks(fitted("a", 0.0, 4.0), priors=narrow) == ["The recording hardly determines a."]


def test_an_effect_that_may_be_absent_is_remarked_unless_nothing_is_known_of_it():
    absent = "effect_0 may be absent: within its interval it does nothing."
    assert remarks(fitted("a", -1.0, 2.0)) == [absent]
    assert remarks(fitted("a", -99.0, 99.0)) == ["The recording hardly determines a."]
    both = [slice(0, 2)]
    assert remarks(fitted("a", -1.0, 2.0), fitted("b", 1.0, 2.0), split=both) == []
    assert remarks(fitted("a", -1.0, 2.0), fitted("b", -1.0, 2.0), split=both) == [absent]
    half = remarks(fitted("a", -99.0, 99.0), fitted("b", -1.0, 2.0), split=both)
    assert half == ["The recording hardly determines a.", absent]
    fingers = fitted("a", -0.5, 2.5), fitted("b", -0.5, 2.5)
    assert absent in remarks(*fingers, split=both, correlation=[[1, 0.999], [0.999, 1]])
    assert absent not in remarks(*fingers, split=both, correlation=[[1, -0.999], [-0.999, 1]])
    second = remarks(fitted("a", 1.0, 2.0), fitted("b", -1.0, 2.0))
    assert second == ["effect_1 may be absent: within its interval it does nothing."]


@pytest.mark.parametrize(("size", "alike"), [(0.985, True), (-0.985, True), (0.975, False), (-0.5, False)])
def test_parameters_that_act_alike_are_remarked_once(size, alike):
    names = [fitted(name, 1.0, 2.0) for name in "abc"]
    correlation = np.eye(3)
    correlation[2, 0] = correlation[0, 2] = size
    found = remarks(*names, correlation=correlation)
    text = f"a and c act so alike in this recording that it determines neither well by itself (correlation {size:.3f})."
    assert found == ([text] if alike else [])
    unknown = [fitted("a", 1.0, 99.0), *names[1:]]
    assert remarks(*unknown, correlation=correlation) == ["The recording hardly determines a."]


def scanned(
    monkeypatch: Any, given: Any, residuals: Any, parameters: Any, cfg: FitEffectsCfg = CFG
) -> tuple[list[float], list[list[float]]]:
    """Return the best start and what was tried, with residuals as a function of the values."""
    tried: list[list[float]] = []

    def at(solver: Any, values: np.ndarray, offsets: Any, starts: Any) -> list[np.ndarray]:
        del solver, offsets, starts
        tried.append(values.tolist())
        return residuals(values)

    monkeypatch.setattr(fitting, "_residuals_at", at)
    return _best_start(solver_of(parameters), np.array(given), [], [], cfg).tolist(), tried


SCANNED = (
    replace(PARAMETERS[0], scan=(1.0, 2.0)),
    replace(PARAMETERS[1], scan=(7.0,)),
    replace(PARAMETERS[2], high=30.0, scan=(5.0,)),
)


def test_each_value_to_try_is_tried_by_itself(monkeypatch):
    level: Any = lambda values: [np.full(4, 2.0), np.full(4, 2.0)]  # noqa: ARG005, E731
    found, tried = scanned(monkeypatch, [0.0, 0.0, np.inf], level, SCANNED)
    assert found == [0.0, 0.0, 30.0]
    assert tried == [[0, 0, 30], [1, 0, 30], [2, 0, 30], [0, 7, 30], [0, 0, 5]]
    found, tried = scanned(monkeypatch, [0.5, 0.0, 3.0], level, SCANNED)
    assert (found, tried) == ([0.5, 0.0, 3.0], [[0.5, 0.0, 3.0], [0.5, 7.0, 3.0]])
    found, tried = scanned(monkeypatch, [0.5, 0.1, 3.0], level, SCANNED)
    assert (found, tried) == ([0.5, 0.1, 3.0], [])


def test_a_fit_starts_from_the_value_that_lowers_the_cost_most_if_it_does_so_by_enough(monkeypatch):
    def best_at_two(values: np.ndarray) -> list[np.ndarray]:
        return [np.full(4, 3.0 if values[0] == 0 else 2.0 if values[0] == 1 else 1.0), np.zeros(4)]

    assert scanned(monkeypatch, [0.0], best_at_two, SCANNED[:1])[0] == [2.0]  # 4 * (9 - 1) / 2 = 16 lower
    picky = FitEffectsCfg(min_scan_gain=16.1)
    assert scanned(monkeypatch, [0.0], best_at_two, SCANNED[:1], picky)[0] == [0.0]
    equal = FitEffectsCfg(min_scan_gain=16.0)
    assert scanned(monkeypatch, [0.0], best_at_two, SCANNED[:1], equal)[0] == [0.0]
    lenient = FitEffectsCfg(min_scan_gain=15.9)
    assert scanned(monkeypatch, [0.0], best_at_two, SCANNED[:1], lenient)[0] == [2.0]


def test_the_limit_of_outliers_is_that_of_the_first_values(monkeypatch):
    def jumpy(values: np.ndarray) -> list[np.ndarray]:
        sizes = {0.0: [3.0, 3.0, 3.0, 3.0, 3.0], 1.0: [1.0, 1.0, 1.0, 1.0, 8.0], 2.0: [0.0, 0.0, 0.0, 0.0, 9.0]}
        return [np.array(sizes[float(values[0])])]

    # Limit 4 * 1.4826 * 3 = 17.8: all within it. Half squares 22.5, 34 and 40.5.
    assert scanned(monkeypatch, [0.0], jumpy, SCANNED[:1])[0] == [0.0]


def test_residuals_are_those_with_the_initial_states_eliminated():
    rng = np.random.default_rng(0)
    plain = [rng.normal(0, 3, 20) for _ in range(2)]
    starts, offsets = [rng.normal(size=(20, 2)) for _ in range(2)], [rng.normal(size=2) for _ in range(2)]
    solver: Any = SimpleNamespace(
        p=SimpleNamespace(residuals=lambda trials: plain if trials == "trials" else []),
        cfg=LeastSquaresCfg(),
        trials=lambda *_: "trials",
    )
    limit = huber_limit(plain)
    for k, found in enumerate(_residuals_at(solver, np.zeros(1), offsets, starts)):
        step = start_step(plain[k], starts[k], offsets[k], limit, 0.0)
        np.testing.assert_allclose(found, plain[k] + starts[k] @ step)
        assert start_cost(found, offsets[k] + step, limit) < start_cost(plain[k], offsets[k], limit)


def test_channels_are_listed_by_their_residual_before_the_fit():
    def reading(channel: str, start: int, stop: int) -> Any:
        return SimpleNamespace(channel=channel, rows=slice(start, stop))

    windows = [
        window(5, readings=(reading("a", 0, 2), reading("b", 2, 5))),
        window(3, readings=(reading("b", 0, 1), reading("c", 1, 3))),
    ]
    before = [np.array([1.0, -1.0, 2.0, 2.0, 2.0]), np.array([4.0, 9.0, 9.0])]
    after = [np.array([0.5, -0.5, 1.0, 1.0, 1.0]), np.array([1.0, 3.0, -3.0])]
    assert _by_channel(windows, before, after) == (
        ChannelError("c", 9.0, 3.0),
        ChannelError("b", np.sqrt(28 / 4), 1.0),
        ChannelError("a", 1.0, 0.5),
    )


def test_the_fall_is_the_share_of_the_squared_residual():
    fitted = FittedEffects(None, (), 4.0, 1.0, (), True, ())  # pyright: ignore[reportArgumentType]
    assert fitted.fall == pytest.approx(15 / 16)
    assert replace(fitted, after=8.0).fall == -3.0
    assert replace(fitted, before=0.0, after=0.0).fall == 1.0
    assert replace(fitted, before=0.5, after=0.25).fall == pytest.approx(0.75)


@pytest.mark.parametrize(("lost", "refused"), [(0, False), (1, False), (2, False), (3, True), (4, True)])
def test_a_model_that_is_lost_in_more_than_half_of_the_windows_is_refused(lost, refused):
    reading = SimpleNamespace(channel="a", time=np.arange(3.0))
    windows = [window(3, readings=(reading, reading)) for _ in range(4)]
    asked: list[Any] = []

    def readers(trials: Any) -> list[Any]:
        asked.append([(t.window, t.values, t.offset) for t in trials])
        return [lambda _, time, k=k: np.where(time == 1.0, np.nan if k < lost else 0.0, 0.0) for k in range(4)]

    prediction: Any = SimpleNamespace(windows=windows, start="start", readers=readers)
    if refused:
        with pytest.raises(ModelError, match="does not stay finite on this recording") as error:
            check_finite(prediction, "here.xml")
        assert "here.xml" in str(error.value)
    else:
        check_finite(prediction, "here.xml")
    assert asked == [[(w, "start", None) for w in range(4)]]


def test_progress_may_be_left_out_and_a_file_may_be_written(tmp_path):
    assert _silent(0.5, "text") is None
    recording = swung(seconds=0.6)
    model = model_with(recording, "joint_damping")
    seen: list[float] = []
    found = fit_effects(model, recording, out=tmp_path / "m.toml", progress=lambda s, _: seen.append(s))
    assert (tmp_path / "m.toml").is_file()
    assert seen[:4] == [0.0, 0.1, 0.3, pytest.approx(0.3 + 0.05)]
    assert seen[-2:] == [0.8, 1.0]
    assert len(found.parameters) == 1


def test_a_fit_that_ends_worse_than_it_began_is_remarked_first(monkeypatch):
    recording = swung(seconds=0.6)
    model = model_with(recording, "joint_damping")
    good = fit_effects(model, recording).model
    monkeypatch.setattr(
        fitting.Solver,
        "polish",
        lambda self, fit: replace(
            self.improve_initial_states(replace(fit, values=fit.values + 0.3), []), converged=False
        ),
    )
    worse = fit_effects(good, recording)
    assert worse.remarks[0].startswith("The fit ended no better than it began (")
    assert f"({worse.after:.3g} x noise, {worse.before:.3g} before)" in worse.remarks[0]
    assert worse.remarks[1].startswith("The fit has not converged")


def test_the_robust_ratio_counts_outliers_by_hubers_loss():
    within = [np.array([1.0, -2.0]), np.array([3.0])]
    assert robust_noise_ratio(within) == pytest.approx(np.sqrt(14 / 3))
    beyond = [np.array([0.0, HUBER + 6.0])]
    assert robust_noise_ratio(beyond) == pytest.approx(np.sqrt((2 * HUBER * (HUBER + 6.0) - HUBER**2) / 2))
