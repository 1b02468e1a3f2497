"""Starts of candidates' fits by gradients through Newton: friction, mass and contact stiffness.

A descent in Newton gives a factor on each (`fit.factors`). Newton's contacts are not MuJoCo's, so the value that a
factor leads to is one more value to be tried, like those that parameters name for that: it counts where the model's own
engine finds it better than they are. It is tried with the node's initial states and with the measured ones: those of
the node have made up for what is missing, and from there a fit may not find back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from concent_warp.diagnosis.search.steps import FittedModel, Screened, remainders, total
from concent_warp.effects.effect import Effect
from concent_warp.errors import ConcentError
from concent_warp.fit.effects.least_squares import Solver
from concent_warp.fit.effects.prediction import Prediction
from concent_warp.fit.newton.scale_factors import FactorCfg, Factors, factors
from concent_warp.model import Model
from concent_warp.recording.recording import Recording

Parallel = Callable[[Callable[..., Screened], Sequence[tuple[Any, ...]], str, float], list[Screened]]
"""Does independent pieces of work, see `concent_warp.diagnosis.diagnose.Procedure.parallel`."""


class GradientStarts:
    """Offers candidates the values that gradients lead to."""

    def __init__(self, model: Model, recording: Recording, cfg: FactorCfg | None = None) -> None:
        """Descend with the model as it is given, so that what Newton cannot do is said at once.

        Raises:
            ModelError: The model has no contact geometry on a free body, or a shape that Newton's contacts lack comes
                near.
            RecordingError: The recording observes no object with contact geometry.
            EngineError: The scene cannot be simulated stably, or Newton tells of another motion than MuJoCo.
        """
        self.recording, self.cfg = recording, cfg
        self._effects = model.effects
        try:
            self.factors = factors(model, recording, cfg)
        except ConcentError as error:
            raise type(error)(str(error).rstrip("."), fix="or diagnose without --gradient") from None

    def led(self, base: FittedModel, screened: Sequence[Screened], parallel: Parallel) -> list[Screened]:
        """Return screened candidates, those with a factor started from it where that is better.

        With effects that were added Newton may have to give up: then they are as they were.
        """
        if base.model.effects != self._effects:
            try:
                self.factors = factors(base.model, self.recording, self.cfg)
            except ConcentError:
                return list(screened)
            self._effects = base.model.effects
        factor = [_factor_of(s.effect, self.factors) for s in screened]
        rows = [k for k, f in enumerate(factor) if f != 1.0]
        found = parallel(_started, [(base, screened[k], factor[k]) for k in rows], "trying what gradients lead to", 0.0)
        led = dict(zip(rows, found, strict=True))
        return [led.get(k, s) for k, s in enumerate(screened)]


def _factor_of(effect: Effect, found: Factors) -> float:
    """Return the factor on what an effect changes; 1 where gradients say nothing of it."""
    if effect.name == "sliding_friction":
        return found.friction
    if effect.name == "contact_compliance":
        return found.stiffness
    if effect.name == "mass":
        return found.mass.get(effect.target[0], 1.0)
    return 1.0


def _moved(effect: Effect, values: np.ndarray, factor: float) -> np.ndarray:
    """Return an effect's parameters (P,) with a factor on the friction, the stiffness or the mass that they stand for.

    The first parameter is a coefficient or a factor, or the time constant of contacts: their stiffness goes with its
    inverse square.
    """
    result = values.copy()
    result[0] *= factor**-0.5 if effect.name == "contact_compliance" else factor
    return result


def _started(base: FittedModel, screened: Screened, factor: float) -> Screened:
    """Return a screened candidate that starts from a factor, where that takes away more of the error than its start."""
    effect = screened.effect
    solver = Solver(Prediction(base.model, (effect,), base.windows, engine=base.engine))
    values = solver.p.start.copy()
    mine = solver.p.split[-1]
    values[mine] = _moved(effect, values[mine], factor)
    values = solver.inside(values)
    before = total(base, [piece.residual for piece in base.pieces])
    best = screened
    for measured in (False, True):
        offsets = [np.zeros_like(o) if measured else o for o in base.fit.offsets]
        gain = (before - total(base, remainders(solver, base, values, offsets))) / max(before, 1e-12)
        if gain > best.scanned:
            best = replace(screened, scanned=gain, start=values, measured=measured)
    return replace(best, simulated=screened.simulated + solver.p.simulated)
