"""Steps of the least squares against dense references, and the rules by which a step is taken, on written-down data."""

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

from concent_warp.fit.effects.least_squares import Fit, LeastSquaresCfg, Linear, Solver, _State, projected
from concent_warp.fit.effects.robust import cauchy_cost, cauchy_weight, huber, huber_limit, huber_weight
from tests.fit.effects.synthetic import SPREAD, TRUTH, SyntheticPrediction

PRIOR = 10.0
ROWS = 14


def solver_of(windows: int = 3, cfg: LeastSquaresCfg | None = None, **options: Any) -> Solver:
    prediction: Any = SyntheticPrediction(np.zeros((windows, 2)), **options)
    return Solver(prediction, cfg)


def problem(seed: int, *, size: int = 3, windows: int = 3) -> dict[str, Any]:
    """Return a random linear problem with a few outliers."""
    rng = np.random.default_rng(seed)
    linear = []
    for _ in range(windows):
        residual = rng.normal(size=ROWS)
        residual[rng.integers(ROWS)] += 40.0
        linear.append(Linear(residual, rng.normal(size=(ROWS, size))))
    starts = [rng.normal(size=(ROWS, 2)) for _ in range(windows)]
    offsets = [rng.normal(0, 2, 2) for _ in range(windows)]
    return {"linear": linear, "starts": starts, "offsets": offsets}


def dense(solver: Solver, given: dict[str, Any], values: np.ndarray, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Return normal matrix and slope of parameters and all initial states together, damped like those of `solve`."""
    size, windows = len(values), len(given["linear"])
    limit = huber_limit([piece.residual for piece in given["linear"]])
    whole, slope = np.zeros((size + 2 * windows,) * 2), np.zeros(size + 2 * windows)
    for w, (piece, start, offset) in enumerate(zip(*given.values(), strict=True)):
        mine = slice(size + 2 * w, size + 2 * w + 2)
        columns = np.zeros((ROWS, len(slope)))
        columns[:, :size], columns[:, mine] = piece.jacobian, start
        weight = np.diag(huber_weight(piece.residual, limit))
        whole += columns.T @ weight @ columns
        slope += columns.T @ weight @ piece.residual
        near = cauchy_weight(offset)
        whole[mine, mine] += np.diag(near * (1 + damping))
        slope[mine] += near * offset
    whole[:size, :size] += np.eye(size) / PRIOR**2
    slope[:size] += (values - solver.p.start) / solver.scale / PRIOR**2
    inner = whole[size:, size:]
    schur = whole[:size, :size] - whole[:size, size:] @ np.linalg.solve(inner, whole[size:, :size])
    whole[:size, :size] += damping * np.diag(np.diag(schur))
    return whole, slope


@pytest.mark.parametrize("damping", [0.0, 0.3, 4.0])
def test_a_step_is_that_of_the_dense_normal_equations(damping):
    solver, given = solver_of(), problem(0)
    values = np.array([0.7, 2.0, -0.3])
    move, moves = solver.solve(**given, values=values, damping=damping)
    whole, slope = dense(solver, given, values, damping)
    expected = -np.linalg.solve(whole, slope)
    np.testing.assert_allclose(np.concatenate([move, *moves]), expected, rtol=1e-9)


def least_within(whole: np.ndarray, slope: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the step of least cost whose first parts are within bounds: each of them free, or at one of its two."""
    best, least, size = np.zeros(len(slope)), 0.0, len(low)
    for choice in product((0, 1, 2), repeat=size):
        free = np.append(np.array(choice) == 0, np.ones(len(slope) - size, dtype=bool))
        step = np.zeros(len(slope))
        step[:size] = np.where(np.array(choice) == 1, low, np.where(np.array(choice) == 2, high, 0.0))
        step[free] = -np.linalg.solve(whole[np.ix_(free, free)], slope[free] + whole[np.ix_(free, ~free)] @ step[~free])
        inside = (step[:size] >= low - 1e-12).all() and (step[:size] <= high + 1e-12).all()
        cost = slope @ step + 0.5 * step @ whole @ step
        if inside and cost < least:
            best, least = step, cost
    return best


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("where", ["low", "high", "near", "beyond", "infinite"])
def test_a_step_is_the_best_one_within_the_bounds(seed, where):
    solver, given = solver_of(), problem(seed)
    inner = np.array([0.7, 2.0, -0.3])
    edges = {
        "low": solver.low,
        "high": solver.high,
        "near": solver.high - 0.01 * solver.scale,
        "beyond": np.array([solver.low[0] - 0.1, solver.high[1] + 0.1, solver.high[2] + 0.1]),
        "infinite": np.array([np.inf, solver.high[1], 0.1]),
    }[where]
    for count in (1, 2, 3):
        values = np.where(np.arange(3) < count, edges, inner)
        move, moves = solver.solve(**given, values=values, damping=0.1)
        finite = np.where(np.isfinite(values), values, solver.p.start)
        whole, slope = dense(solver, given, finite, 0.1)
        low, high = (
            np.minimum(solver.low - values, 0) / solver.scale,
            np.maximum(solver.high - values, 0) / solver.scale,
        )
        low, high = (np.where(np.isinf(values), 0.0, bound) for bound in (low, high))
        expected = least_within(whole, slope, low, high)
        np.testing.assert_allclose(np.concatenate([move, *moves]), expected, rtol=1e-8, atol=1e-12)


def test_a_fit_of_nominal_values_ends_with_a_step_without_damping(monkeypatch):
    solvers, given = [solver_of(cfg=LeastSquaresCfg(iterations=1, damping=1e3)) for _ in range(2)], []
    solvers[1].p.nominal[0] = True
    undamped = Solver.solve

    def solve(self, *args, **options):
        given.append(args[4])
        return undamped(self, *args, **options)

    monkeypatch.setattr(Solver, "solve", solve)
    plain, nominal = (solver.fit(np.array([0.1, 1.4, 0.0])) for solver in solvers)
    assert nominal.cost < plain.cost
    assert given.count(0.0) == 1
    assert given[-1] == 0.0


def test_where_all_parameters_stay_the_initial_states_alone_move():
    solver, given = solver_of(), problem(1)
    values = np.array([np.inf, -np.inf, np.inf])
    move, moves = solver.solve(**given, values=values, damping=0.2)
    np.testing.assert_array_equal(move, 0.0)
    whole, slope = dense(solver, given, solver.p.start, 0.2)
    np.testing.assert_allclose(np.concatenate(moves), -np.linalg.solve(whole[3:, 3:], slope[3:]), rtol=1e-9)


def test_a_direction_that_rounding_makes_negative_keeps_a_positive_curvature():
    solver = solver_of(1)
    start = np.ones((ROWS, 2)) * [1e8, 1.0]
    linear = [Linear(np.zeros(ROWS), np.ones((ROWS, 3)) * [1e8, 0.0, 0.0])]
    move, _ = solver.solve(linear, [start], [np.zeros(2)], solver.p.start, 1e-3)
    assert np.isfinite(move).all()


def test_what_an_initial_state_explains_within_its_prior_is_projected_out():
    given = problem(2)
    fit = Fit(np.zeros(3), tuple(given["offsets"]), 0.0, tuple(given["linear"]), tuple(given["starts"]), True, 0.0)
    for found, piece, start, offset in zip(projected(fit), *given.values(), strict=True):
        root = np.sqrt(cauchy_weight(offset))
        stacked = np.vstack([start, np.diag(root)])
        for column, seen, prior in (
            (piece.residual, found.residual, root * offset),
            *((piece.jacobian[:, k], found.jacobian[:, k], np.zeros(2)) for k in range(3)),
        ):
            explained = np.linalg.lstsq(stacked, np.concatenate([column, prior]), rcond=None)[0]
            np.testing.assert_allclose(seen, column - start @ explained, rtol=1e-9, atol=1e-12)


def test_initial_states_go_with_a_step_of_the_parameters_to_first_order():
    solver, given = solver_of(), problem(3)
    fit = Fit(np.zeros(3), tuple(given["offsets"]), 0.0, tuple(given["linear"]), tuple(given["starts"]), True, 0.0)
    move = np.array([0.3, -0.2, 0.5])
    limit = huber_limit([piece.residual for piece in given["linear"]])
    for found, piece, start, offset in zip(solver.first_order_offsets(fit, move), *given.values(), strict=True):
        root = np.sqrt(huber_weight(piece.residual, limit))
        stacked = np.vstack([root[:, None] * start, np.diag(np.sqrt(cauchy_weight(offset)))])
        right = np.concatenate([root * (piece.jacobian @ move), np.zeros(2)])
        np.testing.assert_allclose(found, offset - np.linalg.lstsq(stacked, right, rcond=None)[0], rtol=1e-9)


def test_the_cost_is_huber_plus_cauchy_plus_the_weak_prior():
    solver = solver_of()
    rng = np.random.default_rng(0)
    residuals, offsets = [rng.normal(0, 5, 30) for _ in range(3)], [rng.normal(0, 3, 2) for _ in range(3)]
    residuals[0][0] = 300.0
    values = np.array([1.1, 0.3, np.inf])
    limit = huber_limit(residuals)
    expected = huber(np.concatenate(residuals), limit).sum() + sum(cauchy_cost(o) for o in offsets)
    prior = np.array([(1.1 - 0.1) / (PRIOR * 0.2), (0.3 - 1.3) / (PRIOR * 0.3), 0.0])
    np.testing.assert_allclose(solver.prior(values), prior)
    assert solver.cost(residuals, offsets, values) == pytest.approx(expected + 0.5 * (prior**2).sum(), rel=1e-12)


def test_a_parameter_that_starts_at_infinity_has_no_prior():
    solver = solver_of(start=(np.inf, 1.3, 0.0))
    np.testing.assert_array_equal(solver.prior(np.array([2.0, 1.3, 0.0])), 0.0)
    np.testing.assert_array_equal(solver.prior(np.array([np.inf, 1.3, 0.0])), 0.0)


def test_sensitivities_are_finite_differences_in_units_of_the_scale():
    solver = solver_of()
    prediction: Any = solver.p
    values, offsets = np.array([0.3, 1.4, 0.1]), [np.array([0.2, -0.1])] * 3
    linear = solver.linearise(values, offsets)
    assert len(prediction.requests) == 9  # three windows at the point and moved along two parameters
    base = solver.p.residuals(solver.trials(values, offsets))
    for k in range(3):
        moved = values.copy()
        moved[k] += 0.1 * solver.scale[k]
        there = solver.p.residuals(solver.trials(moved, offsets))
        for piece, here, away in zip(linear, base, there, strict=True):
            np.testing.assert_array_equal(piece.residual, here)
            np.testing.assert_allclose(piece.jacobian[:, k], (away - here) / 0.1, rtol=1e-9, atol=1e-9)


def test_finite_differences_step_away_from_an_upper_bound():
    solver = solver_of()
    solver.step = np.array([0.1, 0.2, 0.3])
    values = np.array([5.0, 4.9, 0.97])
    np.testing.assert_allclose(solver._steps(values), [-0.1 * 0.2, 0.2 * 0.3, 0.3 * 0.1])
    values = np.array([5.0 - 0.02, 4.95, 0.98])
    np.testing.assert_allclose(solver._steps(values), [0.02, -0.06, -0.03])


def test_finite_differences_aim_at_a_change_of_the_residuals():
    solver = solver_of()
    # Root mean squares of the columns over all windows, in units of the parameters.
    columns = [np.array([[100.0, 0.0, 1.0], [100.0, 0.0, 1.0]]), np.array([[100.0, 0.0, 1e4]])]
    solver._adapt(columns)
    spread = np.sqrt((2 + 1e8) / 3) * 0.1
    np.testing.assert_allclose(solver.step, [3.0 / (100 * 0.2), 0.3, max(3.0 / spread, 0.01)])
    solver._adapt([np.array([[1000.0, 1.0, 1e-9]])])
    np.testing.assert_allclose(solver.step, [3.0 / 200, 0.3, 0.3])


@pytest.mark.parametrize("smooth", [False, True])
def test_where_there_are_contacts_a_finite_difference_that_changes_too_much_is_taken_again(smooth):
    solver = solver_of(2, start=(0.0,), low=(-10.0,), high=(10.0,))
    prediction: Any = solver.p
    prediction.windows = [replace(w, smooth=smooth) for w in prediction.windows]
    # An angle that turns by 400 a unit, in units of noise, and wraps at +-6: its first step of 0.02 leads beyond.
    wrapped = lambda x: (400.0 * x + 6.0) % 12.0 - 6.0  # noqa: E731
    far = lambda x: 1000.0 * x  # noqa: E731
    observed = lambda w, _, values: np.array([far(values[0]), wrapped(values[0])][w : w + 1])  # noqa: E731
    prediction.observed = observed
    prediction.readers = lambda trials: [None] * len(trials)
    prediction.residuals = lambda trials: [observed(t.window, None, t.values) for t in trials]
    first, second = solver.linearise(np.zeros(1), [np.zeros(2)] * 2)
    scale = solver.scale[0]
    assert first.jacobian[0, 0] == pytest.approx(1000.0 * scale)
    wrong = wrapped(0.1 * scale) / 0.1
    assert wrong < 0
    # The second window changes by 4 alone, which is no more than is allowed: only the first is simulated again.
    assert second.jacobian[0, 0] == pytest.approx(wrong)
    prediction.observed = observed = lambda w, _, values: np.array([far(values[0]), 3 * wrapped(values[0])][w : w + 1])
    prediction.residuals = lambda trials: [observed(t.window, None, t.values) for t in trials]
    solver.step = np.array([0.1])
    _, second = solver.linearise(np.zeros(1), [np.zeros(2)] * 2)
    assert second.jacobian[0, 0] == pytest.approx(3 * wrong if smooth else 1200.0 * scale)


def stepper(f: Any, **options: Any) -> tuple[Solver, _State, list[float]]:
    """Return a solver of one parameter whose cost is f(value), its state at 0, and the dampings that are tried."""
    solver = solver_of(1, start=(0.0,), low=(-10.0,), high=(10.0,), **options)
    dampings: list[float] = []

    def solve(linear: Any, starts: Any, offsets: Any, values: np.ndarray, damping: float, most: float) -> Any:
        del linear, starts, offsets, values, most
        dampings.append(damping)
        return np.array([5.0 / len(dampings)]), [np.zeros(2)]  # steps 1, 1/2, 1/3, ...

    mocked: Any = solver
    mocked.solve = solve
    mocked.scale = np.array([0.2])
    mocked.cost = lambda residuals, *_: float(residuals[0][0])
    solver.p.residuals = lambda trials: [np.array([float(f(t.values[0]))]) for t in trials]
    state = _State(np.zeros(1), [np.zeros(2)], float(f(0.0)), (np.zeros((1, 2)),), 0)
    return solver, state, dampings


def linear_of(fall: float) -> list[Linear]:
    """Return a linearisation at cost 100 whose first step is predicted to lower it by `fall`."""
    return [Linear(np.array([100.0]), np.array([[-fall / 5.0]]))]


def test_a_step_that_lowers_the_cost_is_taken_with_less_damping():
    solver, state, dampings = stepper(lambda v: 100 - 50 * v)
    found, damping = solver._advance(state, linear_of(60.0), 1e-3)
    assert dampings == [1e-3]
    assert (found.values[0], found.cost, found.refits) == (1.0, 50.0, 0)
    assert damping == pytest.approx(2e-4)
    state = replace(state, values=np.zeros(1))
    assert solver._advance(state, linear_of(60.0), 2e-6)[1] == 1e-6


def test_a_step_that_raises_the_cost_is_tried_again_with_more_damping():
    solver, state, dampings = stepper(lambda v: 100 + 10 * (v - 0.4))
    state = replace(state, cost=100.0)
    found, damping = solver._advance(state, linear_of(60.0), 1e-3)
    assert dampings == pytest.approx([1e-3, 1e-2, 0.08])  # steps 1, 1/2 and 1/3
    assert found.values[0] == pytest.approx(1 / 3)
    assert damping == pytest.approx(0.08 / 5)


def test_where_no_step_helps_the_point_stays():
    solver, state, dampings = stepper(lambda v: 100 + v)
    found, damping = solver._advance(state, linear_of(60.0), 0.01)
    assert found is state
    assert dampings == pytest.approx([0.01, 0.08, 0.64, 5.12, 40.96])
    assert damping == pytest.approx(8 * 40.96)


@pytest.mark.parametrize(("fall", "refitted"), [(100.0, 1), (60.0, 1), (30.0, 0)])
def test_initial_states_are_fitted_anew_where_the_cost_falls_by_much_less_than_predicted(fall, refitted):
    solver, state, _ = stepper(lambda v: 100 - 10 * v)
    calls: list[Any] = []

    def fit_initial_states(values: Any, begin: Any, iterations: int, known: Any) -> Any:
        calls.append((values.copy(), begin, iterations, known))
        return [np.ones(2)], (np.ones((1, 2)),)

    mocked: Any = solver
    mocked.fit_initial_states = fit_initial_states
    found, damping = solver._advance(replace(state, refits=2), linear_of(fall), 1e-3)
    assert len(calls) == refitted
    assert found.refits == 2 - refitted
    if refitted:
        assert (calls[0][0][0], calls[0][2]) == (1.0, solver.cfg.refit_iterations)
        assert calls[0][3] is state.starts
        np.testing.assert_array_equal(found.offsets, [np.ones(2)])
        np.testing.assert_array_equal(found.starts[0], 1.0)
        assert (found.cost, damping) == (90.0, 1e-3)
    else:
        assert damping == pytest.approx(2e-4)


@pytest.mark.parametrize(("worse", "fresh"), [(150.0, True), (250.0, False)])
def test_refits_begin_where_the_step_led_unless_the_cost_has_doubled(worse, fresh):
    solver, state, dampings = stepper(lambda v: 100 + (worse - 100) * v)
    begun: list[Any] = []
    moves = [np.full(2, 0.5)]
    mocked: Any = solver
    plain = solver.solve
    mocked.solve = lambda *given: (plain(*given)[0], moves)

    def fit_initial_states(values: Any, begin: Any, iterations: int, known: Any) -> Any:
        del values, iterations
        assert known is state.starts
        begun.append(begin[0])
        return list(begin), state.starts

    mocked.fit_initial_states = fit_initial_states
    found, _ = solver._advance(replace(state, refits=2), linear_of(60.0), 1e-3)
    assert found.cost == 100.0
    assert found.refits == 0
    assert len(dampings) == 5
    np.testing.assert_array_equal(begun[0], 0.5 if fresh else 0.0)


def test_a_point_where_the_cost_would_rise_by_its_own_prediction_counts_any_fall():
    solver, state, dampings = stepper(lambda v: 100 - v)
    found, _ = solver._advance(replace(state, refits=1), linear_of(-20.0), 1e-3)
    assert (found.cost, found.refits, len(dampings)) == (99.0, 1, 1)


def test_no_other_method_improves_on_a_fit_of_curved_residuals():
    cfg = LeastSquaresCfg(iterations=60, tolerance=1e-12)
    for low, high in (((0.0, 0.0, -1.0), (5.0, 5.0, 1.0)), ((0.5, 0.0, -1.0), (5.0, 5.0, 0.18))):
        rng = np.random.default_rng(4)
        offsets = rng.normal(size=(3, 2))
        given: Any = SyntheticPrediction(offsets, low=low, high=high, start=(0.6, 1.3, 0.0))
        solver = Solver(given, cfg)
        fit = solver.fit()
        assert fit.converged
        assert ((fit.values >= low) & (fit.values <= high)).all()

        def cost(x: np.ndarray, solver: Solver = solver) -> float:
            moved = list(x[3:].reshape(-1, 2))
            return solver.cost(solver.p.residuals(solver.trials(x[:3], moved)), moved, x[:3])

        begin = np.concatenate([fit.values, *fit.offsets])
        bounds = [*zip(low, high, strict=True), *[(-9.0, 9.0)] * 6]
        assert cost(begin) == pytest.approx(fit.cost)
        other = minimize(cost, begin, bounds=bounds, method="L-BFGS-B", options={"maxiter": 200})
        assert other.fun > fit.cost * (1 - 2e-5)
        np.testing.assert_allclose(other.x[:3], fit.values, atol=0.01)


def test_the_true_parameters_and_initial_states_are_found():
    offsets = np.random.default_rng(5).normal(size=(4, 2))
    given: Any = SyntheticPrediction(offsets, noise=0.01)
    shares: list[float] = []
    fit = Solver(given, LeastSquaresCfg(tolerance=1e-9)).fit(progress=shares.append)
    np.testing.assert_allclose(fit.values, TRUTH, atol=0.03)
    np.testing.assert_allclose(np.array(fit.offsets) * SPREAD, offsets * SPREAD, atol=0.03)
    assert fit.simulated == given.simulated
    np.testing.assert_allclose(shares, (np.arange(len(shares)) + 1) / 10)
