"""Earlier additions tried again beside later ones.

The first of several missing effects is chosen while the others are still missing, and what it leaves is then mostly
theirs. Once they are in the model, its rivals are fitted again in its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from concent_warp.diagnosis.candidates.baseline import add_candidate, fitted_model, refit_without_effect
from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel
from concent_warp.diagnosis.candidates.candidates import has_effect
from concent_warp.diagnosis.candidates.evidence import assess, equal_at_noise, indistinguishable
from concent_warp.diagnosis.candidates.fit_candidate import fitted_candidate
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.result import Finding
from concent_warp.effects.effect import AddedEffect, Effect
from concent_warp.fit.effects.least_squares import Fit


@dataclass(frozen=True)
class Rival:
    """An effect that explained nearly as much as the one that was added."""

    finding: Finding
    added: AddedEffect
    """The effect with its values."""
    fit: Fit
    """Its fit, with all other values and the initial states."""
    removed: np.ndarray = field(default_factory=lambda: np.zeros(0), compare=False)
    """What it takes from the residuals of the model that it was added to, in units of the noise, shape (n,)."""

    def is_like(self, other: Rival, cosine: float) -> bool:
        """Return whether it takes much the same from the residuals as another one: they are parallel."""
        lengths = float(np.linalg.norm(self.removed) * np.linalg.norm(other.removed))
        return bool(self.removed @ other.removed >= cosine * lengths > 0)


@dataclass(frozen=True)
class Reconsidered:
    """The effect that explains most in the place of an added one, all others present."""

    last: FittedModel
    """The model with it."""
    group: tuple[tuple[FittedCandidate, Finding], ...]
    """It, and those that the data cannot distinguish from it."""


def near_best(
    base: FittedModel, fits: Sequence[FittedCandidate], findings: Sequence[Finding], cfg: DiagnoseCfg
) -> tuple[Rival, ...]:
    """Return the fitted candidates that explain nearly as much as the best, best first.

    Args:
        base: The model that they were added to.
        fits: The candidates.
        findings: Their evidence.
        cfg: Settings.
    """
    least = cfg.search.restart_min_gain * max(c.share(base) for c in fits)
    near = [(c, f) for c, f in zip(fits, findings, strict=True) if c.share(base) >= least]
    ranked = sorted(near, key=lambda pair: -pair[0].share(base))
    return tuple(Rival(f, c.model.effects[-1], c.fit, c.removed(base)) for c, f in ranked)


def beside(base: FittedModel, rival: Rival) -> FittedModel:
    """Return a fitted model with a rival added, all fitted again from where its fit ended."""
    solver, shapes = base.solver(rival.added.effect), [o.shape for o in base.fit.offsets]
    # Over other windows than these it has other initial states.
    start = rival.fit if [o.shape for o in rival.fit.offsets] == shapes else base.fit
    values = np.concatenate([base.fit.values, rival.added.array])
    fit = solver.polish(solver.fit(values, start.offsets, start.starts))
    return add_candidate(base, fitted_candidate(base, rival.added.effect, solver, fit))


def reconsider(last: FittedModel, effect: int, among: Sequence[Rival], cfg: DiagnoseCfg) -> Reconsidered | None:
    """Return which of some rivals explains most in the place of an effect; None where none explains as much as it does.

    A rival must have been better than chance when it was compared, and its gain beside the others certain.

    Args:
        last: The fitted model.
        effect: Index of the effect among those of the model.
        among: The effect itself and its rivals.
        cfg: Settings.
    """
    base = refit_without_effect(last, effect)
    present = last.model.effects[effect].effect
    others, pairs = np.delete(last.fit.values, np.r_[last.prediction().split[effect]]), []
    for rival in among:
        if has_effect(base.model, rival.added.effect):
            continue
        solver = base.solver(rival.added.effect)
        values = np.concatenate([others, rival.added.array])
        fit = solver.polish(solver.fit(values, last.fit.offsets, last.fit.starts))
        c = fitted_candidate(base, rival.added.effect, solver, fit)
        f = assess(base, c, np.zeros(1), rival.finding.step, [rival.added.effect], cfg)
        old = rival.finding
        certain = _is_same(rival.added.effect, present) or (old.p <= cfg.significance_level and f.low > 0)
        if certain and not any(p.at_bound for p in f.parameters) and c.share(base) >= cfg.min_gain:
            pairs.append((c, replace(f, name=old.name, p=old.p, smallest_p=old.smallest_p, accepted=True, reason="")))
    if not pairs:
        return None
    group = indistinguishable(base, pairs, cfg.search)
    if any(added.effect.nominal for added in base.model.effects):
        group = equal_at_noise(base, group, pairs, cfg.search)
    found = _in_place(last, effect, group[0][0])
    as_good = found.errors.sum() <= (1 + cfg.search.equal_error) * last.errors.sum()
    return Reconsidered(found, tuple(group)) if as_good else None


def _in_place(last: FittedModel, effect: int, c: FittedCandidate) -> FittedModel:
    """Return a fitted model with another effect in the place of one."""
    *others, added = c.model.effects
    model = replace(last.model, effects=(*others[:effect], added, *others[effect:]))
    solver = replace(last, model=model).solver()
    fit = solver.fit(offsets=c.fit.offsets, starts=c.fit.starts)
    found = fitted_model(solver.p.model(fit.values), last.windows, last.blocks, fit, last.engine, last.cfg)
    same = _is_same(added.effect, last.model.effects[effect].effect)
    return last if same and last.fit.cost <= found.fit.cost else found


def _is_same(one: Effect, other: Effect) -> bool:
    """Return whether two effects are the same, on the same target."""
    return one.name == other.name and one.target == other.target
