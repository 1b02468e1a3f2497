"""Time step that resolves the impacts of bodies that fly, for the values of an effect of contacts.

A simulated impact takes a few steps of the model as a rule, and how fast a body leaves it then depends on when between
two steps it begins. While effects are looked for, that scatter counts as noise. It tells which effect is missing; but
constants of contacts that are fitted within it are those of the long step, and may be off by more than their intervals.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from concent_warp.diagnosis.candidates.baseline import fitted_model
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.constants import FinerTimeStep
from concent_warp.diagnosis.search.time_step import with_time_step, without_defects
from concent_warp.fit.effects.impacts import impacts
from concent_warp.fit.effects.robust import huber
from concent_warp.fit.effects.scatter import with_scatter


def resolved_impacts(last: FittedModel, cfg: DiagnoseCfg) -> tuple[FittedModel, FinerTimeStep] | None:
    """Return a fitted model with a time step that resolves its impacts, and what that changes.

    It is None where nothing that flew hits anything, where the step resolves that already, or where a shorter one makes
    the data no more likely: residuals have a normal distribution whose covariance is that of noise and scatter, so that
    a model which explains them as well with less scatter is the more likely one.

    Args:
        last: The fitted model.
        cfg: Settings.
    """
    settings, solver = cfg.time_step, last.solver()
    courses = solver.p.courses(solver.trials(last.fit.values, last.fit.offsets))
    found = [impact for c in courses for impact in impacts(solver.p.compiled, c, last.cfg.observation) if impact.flies]
    shortest = min((impact.step - impact.begin for impact in found), default=settings.steps_of_impact)
    division = min(int(np.ceil(settings.steps_of_impact / shortest)), settings.max_division)
    if division < 2:
        return None
    finer = with_time_step(last, last.timestep / division)
    begun = [offset * w.spread for offset, w in zip(last.fit.offsets, last.windows, strict=True)]
    plain = without_defects(last).windows
    windows = tuple(with_scatter(finer.delivered, plain, last.engine, last.cfg.observation, begun))
    solver = replace(finer, windows=windows).solver()
    fit = solver.fit(last.fit.values, last.fit.offsets, last.fit.starts)
    fit = solver.improve_initial_states(fit, [])
    one = fitted_model(solver.p.model(fit.values), windows, last.blocks, fit, last.engine, last.cfg)
    if log_likelihood(one) - log_likelihood(last) < cfg.min_impact_evidence:
        return None
    before, after = _scatter(last), _scatter(one)
    gain = 1 - after / max(before, 1e-12)
    return one, FinerTimeStep(last.timestep, one.timestep, last.noise_scale * before, gain, gain, gain, impacts=True)


def log_likelihood(one: FittedModel) -> float:
    """Return the log likelihood of a fitted model's residuals by their noise and scatter, but for a constant."""
    total = 0.0
    for w, linear in zip(one.windows, one.fit.linear, strict=True):
        total -= float(huber(linear.residual, one.limit).sum())
        total -= 0.0 if w.scatter is None else 0.5 * w.scatter.log_determinant
    return total


def _scatter(one: FittedModel) -> float:
    """Return the root mean square of the scatter of a model's predictions over the noise [-]."""
    square = sum(w.scatter.square for w in one.windows if w.scatter is not None)
    return float(np.sqrt(square / sum(w.count for w in one.windows)))
