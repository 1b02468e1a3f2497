"""Starts of candidates' fits by gradients through Newton: friction, mass and contact stiffness.

A descent in Newton gives a factor on each (`concent_warp.fit.newton.scale_factors`). Newton's contacts differ from
MuJoCo's, so the value that a factor gives is one more scanned value: it is used where the model's own engine finds a
larger gain than for the others. It is tried with the baseline's initial states and with the measured ones, since those
of the baseline compensate for the missing effect, from which a fit may not recover.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from concent_warp.diagnosis.candidates.candidate import FittedModel, ScreenedCandidate
from concent_warp.diagnosis.candidates.fit_candidate import candidate_solver
from concent_warp.diagnosis.candidates.screening import foretold_residuals, projected_residuals, robust_sum
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.effects.effect import Effect
from concent_warp.errors import ConcentError
from concent_warp.fit.newton.scale_factors import FactorCfg, Factors, factors
from concent_warp.model import Model
from concent_warp.recording.recording import Recording


class GradientStarts:
    """Starts candidates from the values that gradients give."""

    def __init__(self, model: Model, recording: Recording, cfg: FactorCfg | None = None) -> None:
        """Descend with the model as given, so that what Newton cannot simulate raises at once.

        Raises:
            ModelError: The model has no contact geometry on a free body, or a shape that Newton's contacts lack comes
                near.
            RecordingError: The recording observes no object with contact geometry.
            EngineError: The scene cannot be simulated stably, or Newton simulates another motion than MuJoCo.
        """
        self.recording, self.cfg = recording, cfg
        self._effects = model.effects
        try:
            self.factors = factors(model, recording, cfg)
        except ConcentError as error:
            raise type(error)(str(error).rstrip("."), fix="or diagnose without --gradient") from None

    def apply(
        self, base: FittedModel, screened: Sequence[ScreenedCandidate], runner: TaskRunner
    ) -> list[ScreenedCandidate]:
        """Return screened candidates, those with a factor started from it where that gains more.

        Where Newton cannot simulate effects that were added, they are returned as they were.
        """
        if base.model.effects != self._effects:
            try:
                self.factors = factors(base.model, self.recording, self.cfg)
            except ConcentError:
                return list(screened)
            self._effects = base.model.effects
        factor = [_factor_of(s.effect, self.factors) for s in screened]
        rows = [k for k, f in enumerate(factor) if f != 1.0]
        tasks = [(base, screened[k], factor[k]) for k in rows]
        started = dict(zip(rows, runner.run_in_time(start_from_factor, tasks, "starts from gradients"), strict=True))
        return [started.get(k) or s for k, s in enumerate(screened)]


def _factor_of(effect: Effect, found: Factors) -> float:
    """Return the factor on what an effect changes; 1 where gradients give none."""
    if effect.name == "sliding_friction":
        return found.friction
    if effect.name == "contact_compliance":
        return found.stiffness
    if effect.name == "mass":
        return found.mass.get(effect.target[0], 1.0)
    return 1.0


def _scaled(effect: Effect, values: np.ndarray, factor: float) -> np.ndarray:
    """Return an effect's parameters (P,) with a factor on its friction, stiffness or mass.

    The first parameter is a coefficient, a factor, or the time constant of contacts, whose inverse square their
    stiffness is proportional to.
    """
    result = values.copy()
    result[0] *= factor**-0.5 if effect.name == "contact_compliance" else factor
    return result


def start_from_factor(base: FittedModel, screened: ScreenedCandidate, factor: float) -> ScreenedCandidate:
    """Return a screened candidate that starts from a factor, where that gains more than its start."""
    effect = screened.effect
    solver = candidate_solver(base, effect)
    values = solver.p.start.copy()
    own = solver.p.split[-1]
    values[own] = _scaled(effect, values[own], factor)
    values = solver.inside(values)
    before = robust_sum(base, foretold_residuals(base))
    best = screened
    for measured in (False, True):
        offsets = [np.zeros_like(o) if measured else o for o in base.fit.offsets]
        after = robust_sum(base, projected_residuals(solver, base, values, offsets))
        gain = (before - after) / max(before, 1e-12)
        if gain > best.scanned_gain:
            best = replace(screened, scanned_gain=gain, start=values, measured=measured)
    return best
