"""Windows in which the derivatives by the initial state foretell a fit that no step of it attains.

Where a body slides and rolls, or lands, residuals jump a little from one initial state to the next. Derivatives are
those of the jumps then, and a linear step along them seems to explain what no initial state does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from concent_warp.fit.effects.initial_states import start_step
from concent_warp.fit.effects.least_squares import Fit, Solver, projected
from concent_warp.fit.effects.prediction import SimulationRequest


def with_rough_windows(solver: Solver, fit: Fit) -> Fit:
    """Return a fit that says in which windows no step of the initial state lowers the residuals as foretold.

    The step to the foretold minimum is tried, and parts of it. One counts that attains
    `LeastSquaresCfg.predicted_share` of what is foretold for it. Windows without contacts are not tried, nor those that
    leave no more than noise.

    Args:
        solver: The solver of the fit.
        fit: The fit.
    """
    doubted = _doubted(solver, fit)
    if not doubted:
        return replace(fit, rough=())
    lengths = solver.cfg.doubted_step_lengths
    steps = {
        w: start_step(fit.linear[w].residual, fit.starts[w], fit.offsets[w], np.inf, 0.0, solver.cfg.robust)
        for w in doubted
    }
    trials = [
        SimulationRequest(w, fit.values, (fit.offsets[w] + length * steps[w]) * solver.p.windows[w].spread)
        for w in doubted
        for length in lengths
    ]
    left = np.reshape([_square(r) for r in solver.p.residuals(trials)], (len(doubted), len(lengths)))
    # Along the step to its minimum a parabola falls by 2 t - t^2 of all that it falls.
    shares = np.array([2 * t - t**2 for t in lengths])
    rough = []
    for (w, foretold), squares in zip(doubted.items(), left, strict=True):
        falls = _square(fit.linear[w].residual) - squares
        if (falls < solver.cfg.predicted_share * shares * foretold).all():
            rough.append(w)
    return replace(fit, rough=tuple(rough))


def _doubted(solver: Solver, fit: Fit) -> dict[int, float]:
    """Return the foretold falls of the sum of squares by window, where these are large."""
    found = {}
    linear = projected(replace(fit, rough=()), solver.cfg.robust)
    for w, (now, foretold) in enumerate(zip(fit.linear, linear, strict=True)):
        square, fall = _square(now.residual), _square(now.residual) - _square(foretold.residual)
        noise = solver.cfg.noise_ratio**2 * len(now.residual)
        if not solver.p.windows[w].smooth and square > noise and fall > solver.cfg.doubted_share * square:
            found[w] = fall
    return found


def _square(residual: np.ndarray) -> float:
    """Return the sum of squares."""
    return float(np.dot(residual, residual))
