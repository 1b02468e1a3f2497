"""Plain least squares, all candidate effects at once and none left out: for `alternatives.py`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from concent_warp.diagnosis.candidates.candidates import candidates
from concent_warp.effects.effect import Effect, Parameter
from concent_warp.fit.effects.least_squares import LeastSquaresCfg, Solver, projected
from concent_warp.fit.effects.observe import observe
from concent_warp.fit.effects.prediction import Prediction
from concent_warp.model import Model
from concent_warp.recording.recording import Recording

ITERATIONS = 15
CONFIDENCE = 1.96
"""Half the width of a 95 % interval, in standard errors."""


@dataclass(frozen=True)
class Blame:
    """An effect that is said to be there."""

    name: str
    group: tuple[str, ...]
    """Names that the data do not distinguish from it, including its own."""


def fit_everything(model: Model, recording: Recording) -> tuple[Model, list[Blame]]:
    """Fit all effects that a model could lack, with the initial states; return the model and what is off its null."""
    effects = candidates(model, {c for d in recording.demonstrations for c in d.measured})
    prediction = Prediction(model, effects, observe(model, recording), threads=1)
    solver = Solver(prediction, LeastSquaresCfg(iterations=ITERATIONS))
    # A limit that is infinite where it does nothing starts at its upper bound, far away.
    fit = solver.fit(np.where(np.isfinite(prediction.start), prediction.start, solver.high))
    pieces = projected(fit)
    residual = np.concatenate([piece.residual for piece in pieces])
    jacobian = np.concatenate([piece.jacobian for piece in pieces])
    errors = standard_errors(residual, jacobian) * solver.scale
    return prediction.model(fit.values), blamed(
        prediction.effects, prediction.split, prediction.parameters, fit.values, errors, prediction.owned
    )


def standard_errors(residual: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
    """Return the standard errors of the parameters of a least-squares fit, infinite where nothing tells them.

    sqrt(diag(s^2 (J'J)^-1)) with s^2 = r'r / (n - P): independent residuals of one size, as usual.
    """
    rows, size = jacobian.shape
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian)
    lost = values <= 1e-10 * max(float(values[-1]), 1e-300)
    variance = vectors[:, ~lost] ** 2 @ (1.0 / values[~lost])
    variance[(vectors[:, lost] ** 2).sum(axis=1) > 1e-6] = np.inf
    return np.sqrt(variance * float(residual @ residual) / max(rows - size, 1))


def blamed(
    effects: Sequence[Effect],
    split: Sequence[slice],
    parameters: Sequence[Parameter],
    values: np.ndarray,
    errors: np.ndarray,
    owned: int = 0,
) -> list[Blame]:
    """Return the effects of which a parameter is off its null value by more than its interval; `owned` first ones not.

    A parameter that is infinite where it does nothing, a limit, is off if its interval ends below its upper bound.
    """
    found = []
    for effect, part in zip(effects, split, strict=True):
        for k in range(max(part.start, owned), part.stop):
            p = parameters[k]
            reach = CONFIDENCE * errors[k]
            null = p.null if np.isfinite(p.null) else p.high
            if np.isfinite(reach) and abs(values[k] - null) > reach and abs(values[k] - null) > 1e-9 * p.scale:
                found.append(Blame(effect.name, (effect.name,)))
                break
    return found
