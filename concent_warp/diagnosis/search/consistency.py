"""Whether the values of an effect are the same in all windows of a recording.

An effect that is missing has one value. What imitates it, such as a tilt in the place of a magnet below a table, or
more friction in that of a rough patch, has another one in each throw or push: values fitted to each window by itself
then differ by more than their errors (a test of constant coefficients: Chow, Econometrica 28, 1960; of replications:
Cochran, Biometrics 10, 1954).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from concent_warp.diagnosis.candidates.baseline import fit_baseline
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.null_distribution import null_p_value
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.result import UnknownForceFound
from concent_warp.diagnosis.search.adequacy import discrepancies
from concent_warp.diagnosis.search.unknown_force import Results, unknown_force
from concent_warp.effects.effect import AddedEffect
from concent_warp.fit.effects.cross_validation import block_sums
from concent_warp.model import Model

Hypotheses = Sequence[Mapping[str, Model]]
"""Models with each effect that the data do not distinguish at their end, of each addition."""


def beyond_effects(
    nodes: Sequence[FittedModel], hypotheses: Hypotheses, cfg: DiagnoseCfg, results: Results, *, form_corrected: bool
) -> UnknownForceFound | None:
    """Return what explains more than the effects of the last model do, None where nothing does.

    It is a force of no known form or, where that explains nothing or an error in a formula, an effect that is not the
    same in all windows.

    Args:
        nodes: The fitted model as given and those after each addition.
        hypotheses: See `inconsistent_effect`.
        cfg: Settings.
        results: See `Results`.
        form_corrected: Whether a flexible correction of the effects takes away what they leave.
    """
    found = unknown_force(nodes, cfg, results)
    if found is None or found.form_error:
        found = inconsistent_effect(nodes[0], nodes[-1], hypotheses, cfg) or found
    if found is not None and form_corrected and found.share < cfg.max_form_error:
        return replace(found, form_error=True)
    return found


def inconsistent_effect(
    first: FittedModel, last: FittedModel, hypotheses: Hypotheses, cfg: DiagnoseCfg
) -> UnknownForceFound | None:
    """Return which effect of a model has other values in other windows, as what explains more; None where none has.

    Of several it is the one whose variation explains most of the discrepancy; what explains less than an error in its
    formula may is none. Nor is one in whose place another one that the data do not distinguish from it is the same in
    all windows.

    Args:
        first: The fitted model as given.
        last: The same with effects.
        hypotheses: Models with each effect of a group at their end, of each addition.
        cfg: Settings.
    """
    if len(last.windows) < 2:
        return None
    names, found = [added.effect.name for added in first.model.effects], []
    for k, added in enumerate(last.model.effects):
        if added.effect.nominal or added.effect.name in names:
            continue
        if (more := _variation_found(first, last, k, cfg)) is None:
            continue
        effects = last.model.effects
        present = [repr(other.effect) for other in effects]
        others = (
            replace(last.model, effects=(*effects[:k], other, *effects[k + 1 :]))
            for other in _rivals(added, hypotheses)
            if repr(other.effect) not in present
        )
        fits = (fit_baseline(m, last.windows, last.blocks, last.engine, cfg=last.cfg) for m in others)
        if all(_variation_found(first, fit, k, cfg) is not None for fit in fits):
            found.append(more)
    return max(found, key=lambda f: f.share, default=None)


def _rivals(added: AddedEffect, hypotheses: Hypotheses) -> list[AddedEffect]:
    """Return the effects that the data do not distinguish from one, with their values."""
    for equal in hypotheses:
        ends = [model.effects[-1] for model in equal.values() if model.effects]
        others = [end for end in ends if repr(end.effect) != repr(added.effect)]
        if len(others) < len(ends):
            return others
    return []


def _variation_found(first: FittedModel, one: FittedModel, effect: int, cfg: DiagnoseCfg) -> UnknownForceFound | None:
    """Return the variation of an effect, by its index, where it is significant and no error in a formula; else None."""
    more, kind = variation(one, effect, cfg), one.model.effects[effect].effect
    if more.p > cfg.significance_level:
        return None
    lacked, rows = max(discrepancies(one, first)[1], cfg.unknown_force.min_gain), sum(map(len, one.blocks.of_row))
    share = one.noise_scale**2 * more.excess / rows / lacked
    least = cfg.small_form_error if kind.exact else cfg.unknown_force.min_share
    words = f"{kind.name} with another value in each window"
    return None if share < least else UnknownForceFound(words, more.gain, more.p, min(share, 1.0), varies=True)


@dataclass(frozen=True)
class Variation:
    """What values of an effect explain that differ from window to window, beyond common ones."""

    excess: float
    """Fall of the robust sum of squares beyond that which noise alone brings, in units of the noise [-]."""
    gain: float
    """The same as a share of that sum [-]."""
    p: float
    """Probability that the fall is as large where the values are the same [-]."""


def variation(one: FittedModel, effect: int, cfg: DiagnoseCfg) -> Variation:
    """Return what other values of an effect in each window explain, by a linear step; all else is common.

    The fall of the sum of squares is compared with that of white noise, and with that of residuals whose sign is
    flipped at random in whole blocks of time, which may be correlated: the larger probability counts.

    Args:
        one: The fitted model.
        effect: Index of the effect among those of the model.
        cfg: Settings.
    """
    sums = block_sums(one.pieces, one.blocks, one.limit)
    part = one.prediction().split[effect]
    own, count = range(part.start, part.stop), len(one.windows)
    size, width = sums.slope.shape[1], part.stop - part.start
    slope = np.zeros((one.blocks.count, size + count * width))
    normal = np.zeros((slope.shape[1],) * 2)
    for w, rows in enumerate(one.blocks.of_row):
        mine = np.unique(rows)
        # Columns of all windows together, and again those of the effect in this window.
        columns = np.r_[np.arange(size), size + w * width + np.arange(width)]
        taken = np.r_[np.arange(size), own]
        slope[np.ix_(mine, columns)] = sums.slope[mine][:, taken]
        normal[np.ix_(columns, columns)] += sums.normal[mine].sum(axis=0)[np.ix_(taken, taken)]
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-30))
    slope, normal = slope / scale, normal / np.outer(scale, scale)
    free, common = (np.linalg.pinv(n, rcond=1e-8, hermitian=True) for n in (normal, normal[:size, :size]))

    def fall(u: np.ndarray) -> np.ndarray:
        """Return by how much the sum of squares falls, shape (...), for slopes (..., P)."""
        more = np.einsum("...i,ij,...j->...", u, free, u)
        return more - np.einsum("...i,ij,...j->...", u[..., :size], common, u[..., :size])

    ranks = [int(np.linalg.matrix_rank(n, tol=1e-8, hermitian=True)) for n in (normal, normal[:size, :size])]
    freedom, noise = ranks[0] - ranks[1], max(1.0, one.ratio / one.noise_scale) ** 2
    seen = float(fall(slope.sum(axis=0)))
    signs = np.random.default_rng(cfg.seed).choice([-1.0, 1.0], size=(cfg.null_samples, one.blocks.count))
    p = max(float(chdtrc(max(freedom, 1), seen / noise)), null_p_value(fall(signs @ slope), seen))
    excess = max(seen - noise * freedom, 0.0)
    return Variation(excess, excess / max(float(sums.square.sum()), 1e-12), p)
