"""Evidence for a fitted effect: parameters with intervals, held-out gain, p-value, and which others explain as much."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from concent_warp.diagnosis.candidates.baseline import BOUND_DISTANCE
from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel, ScreenedCandidate
from concent_warp.diagnosis.candidates.candidates import label
from concent_warp.diagnosis.candidates.null_distribution import null_p_value
from concent_warp.diagnosis.cfg import DiagnoseCfg, SearchCfg
from concent_warp.diagnosis.detectable import Detectable
from concent_warp.diagnosis.result import Finding
from concent_warp.effects.effect import Effect, Parameter
from concent_warp.fit.effects.cross_validation import Sums, bootstrap_interval, sign_flip_p
from concent_warp.fit.effects.intervals import (
    NORMAL_QUANTILE,
    FittedParameter,
    covariance,
    excludes_null,
    formula_errors,
)

AT_NULL = "its parameters may be at their null values"
"""Why a candidate is refused whose intervals all include the values that change nothing."""
FORMULA_ACCURACY = 0.25
"""Share of what a model has by which its formulas are off outside a simulator [-], as for `UnknownForceCfg`."""


def assess(
    base: FittedModel, c: FittedCandidate, null: np.ndarray, step: int, among: Sequence[Effect], cfg: DiagnoseCfg
) -> Finding:
    """Return a fitted candidate with its evidence, and whether it is accepted.

    Args:
        base: The fitted baseline.
        c: The candidate.
        null: Null distribution of the best candidate's gain, shape (n,).
        step: Index of the addition.
        among: All candidates of this addition.
        cfg: Settings.
    """
    rng = np.random.default_rng(cfg.seed)
    share, gain = c.share(base), c.gain(base)
    low, high = bootstrap_interval(gain, base.errors, base.blocks.demonstration, rng)
    p, parameters = null_p_value(null, share), fitted_parameters(base, c)
    folds = np.array([gain[base.blocks.fold == f].sum() for f in np.unique(base.blocks.fold)])
    reason = ""
    if p > cfg.significance_level:
        reason = "no better than chance"
    elif share < cfg.min_gain:
        reason = f"removes less than {100 * cfg.min_gain:.0f} % of the error"
    elif low <= 0:
        reason = "the interval of its gain includes zero"
    elif folds[folds > 0].sum() < cfg.search.min_fold_share * np.abs(folds).sum():
        reason = "folds disagree"
    elif not excludes_null(parameters, fitted_covariance(base, c), cfg.search.dependent_share):
        reason = AT_NULL
    elif any(q.at_bound for q in parameters):
        reason = "a parameter is at its bound"
    return Finding(
        label(c.effect, among),
        c.effect.target,
        c.effect.family,
        parameters,
        share,
        low,
        high,
        p,
        sign_flip_p(gain, rng),
        not reason,
        step,
        removed_by_channel(base, c),
        reason,
        null_p_value(null, np.inf),
    )


def with_scattering(
    base: FittedModel, fitted: Sequence[FittedCandidate], findings: Sequence[Finding], cfg: SearchCfg
) -> list[Finding]:
    """Return findings, one accepted that explains more than all accepted ones and was refused for its scatter alone.

    Its null value scatters between measurements by more than the fitted one differs from it, as that of a rebound does.
    Where other effects explain nearly as much, such a difference is no reason to name it; where all others explain
    clearly less, each of them would stand for it.

    Args:
        base: The fitted baseline.
        fitted: The candidates.
        findings: Their evidence, in the same order.
        cfg: Settings.
    """
    found, accepted = list(findings), [c for c, f in zip(fitted, findings, strict=True) if f.accepted]
    if not accepted:
        return found
    best = max(fitted, key=lambda c: c.share(base))
    k = next(i for i, c in enumerate(fitted) if c is best)
    if found[k].reason != AT_NULL:
        return found
    least = min(accepted, key=lambda c: c.errors.sum())
    if not leaves_more(least.errors, best.errors, cfg):
        return found
    parameters = fitted_parameters(base, best, null_known=True)
    if excludes_null(parameters, fitted_covariance(base, best, null_known=True), cfg.dependent_share):
        found[k] = replace(found[k], accepted=True, reason="")
    return found


def without_implausible(
    base: FittedModel, fitted: Sequence[FittedCandidate], findings: Sequence[Finding], cfg: DiagnoseCfg
) -> list[Finding]:
    """Return findings, accepted ones of sizes far beyond typical ones refused where one of a plausible size is enough.

    That one leaves no more besides than an error in its formula may be: as `DiagnoseCfg.max_typical_sizes` says of a
    remainder, such an error is the more plausible cause.

    Args:
        base: The fitted baseline.
        fitted: The candidates.
        findings: Their evidence, in the same order.
        cfg: Settings.
    """
    accepted = [c for c, f in zip(fitted, findings, strict=True) if f.accepted]
    implausible = [c for c in accepted if largest_size(base, c) > cfg.max_typical_sizes]
    plausible = [c for c in accepted if not any(c is other for other in implausible)]
    enough = max((c.share(base) for c in plausible), default=-np.inf) + cfg.unknown_force.min_share
    reason = "explains no more than errors in formulas beside another one, by a size far beyond typical ones"
    return [
        replace(f, accepted=False, reason=reason)
        if any(c is other for other in implausible) and c.share(base) <= enough
        else f
        for c, f in zip(fitted, findings, strict=True)
    ]


def fitted_parameters(
    base: FittedModel, c: FittedCandidate, *, null_known: bool = False
) -> tuple[FittedParameter, ...]:
    """Return the parameters of a candidate with their 95 % intervals (normal, robust to correlation in blocks).

    The error of the formula itself is included, see `formula_errors`, also for `null_known`. A parameter that is 0
    where the model has more, such as friction that is not there, is at a bound only where the data ask for less than 0
    by more than its interval, and by more than the accuracy of formulas.
    """
    prediction = base.prediction(c.effect)
    own = slice(prediction.owned, None)
    parameters, values = prediction.parameters[own], c.fit.values[own]
    reaches = NORMAL_QUANTILE * np.sqrt(np.diag(fitted_covariance(base, c, null_known=null_known)))
    found = tuple(
        FittedParameter.within(p, float(value), float(reach))
        for p, value, reach in zip(parameters, values, reaches, strict=True)
    )
    absent = [
        q.at_bound and p.low == 0.0 < p.null < np.inf and abs(q.value) < BOUND_DISTANCE * p.scale
        for p, q in zip(parameters, found, strict=True)
    ]
    if not any(absent):
        return found
    allowed = np.maximum(
        reaches, [FORMULA_ACCURACY * p.null if gone else 0.0 for p, gone in zip(parameters, absent, strict=True)]
    )
    beyond = _free_step(c.sums, base.cfg.least_squares.prior)[own] * [p.scale for p in parameters] < -allowed
    pairs = zip(found, absent, beyond, strict=True)
    return tuple(replace(q, at_bound=bool(asked)) if gone else q for q, gone, asked in pairs)


def _free_step(sums: Sums, prior: float) -> np.ndarray:
    """Return the linear step to the least error without bounds, in units of the parameters' scales, shape (P,)."""
    normal = sums.normal.sum(axis=0)
    return -np.linalg.pinv(normal + np.eye(len(normal)) / prior**2, hermitian=True) @ sums.slope.sum(axis=0)


def fitted_covariance(base: FittedModel, c: FittedCandidate, *, null_known: bool = False) -> np.ndarray:
    """Return the covariance of a candidate's own parameters, in their units (P, P), see `fitted_parameters`."""
    prediction = base.prediction(c.effect)
    own = slice(prediction.owned, None)
    parameters, values = prediction.parameters[own], c.fit.values[own]
    found = covariance(c.sums, base.blocks, base.cfg.least_squares.prior)[own, own]
    scale, std = np.array([p.scale for p in parameters]), np.sqrt(np.diag(found))
    wide = scale * (1.0 if c.std is None else c.std[own] / std)
    formula = formula_errors(c.effect, parameters, values, base.cfg.discretisation_error, null_known=null_known)
    return found * np.outer(wide, wide) + np.diag(formula**2)


def profile_widening(base: FittedModel, c: FittedCandidate) -> np.ndarray:
    """Return by how much a candidate's profile likelihood is wider than its linear fit, a factor a parameter (P,)."""
    own = slice(base.prediction(c.effect).owned, None)
    linear = np.sqrt(np.diag(covariance(c.sums, base.blocks, base.cfg.least_squares.prior)))[own]
    return np.ones(len(linear)) if c.std is None else c.std[own] / linear


def removed_by_channel(base: FittedModel, c: FittedCandidate) -> tuple[tuple[str, float], ...]:
    """Return by how much the squared residual of each channel falls, as a share, largest first."""
    before: dict[str, float] = {}
    after: dict[str, float] = {}
    for window, old, new in zip(base.windows, base.pieces, c.pieces, strict=True):
        for r in window.readings:
            before[r.channel] = before.get(r.channel, 0.0) + float(np.sum(old.residual[r.rows] ** 2))
            after[r.channel] = after.get(r.channel, 0.0) + float(np.sum(new.residual[r.rows] ** 2))
    shares = {name: 1.0 - after[name] / max(value, 1e-12) for name, value in before.items()}
    return tuple(sorted(((n, s) for n, s in shares.items() if s > 0), key=lambda pair: -pair[1]))


def indistinguishable(
    base: FittedModel,
    accepted: Sequence[tuple[FittedCandidate, Finding]],
    cfg: SearchCfg,
    slack: float = 1.0,
) -> list[tuple[FittedCandidate, Finding]]:
    """Return the accepted candidates that the data cannot distinguish from the best, the most plausible first.

    Their held-out errors differ from the best one's by less than `equal_standard_errors` standard errors, over blocks
    and including the roughness of the costs, or by less than the share `equal_error`. A candidate that leaves more also
    counts where the best is so much rarer that this outweighs it: the formula of a similar effect may fit slightly
    better than that of the missing one, as simulations of the same formula differ too; it must not leave more than the
    most plausible one by as much. One whose posterior odds against the most plausible are worse than `max_odds` is left
    out, and so is one that has another one of them as a special case: what its further parameters explain is no
    evidence. Nor is it evidence of an effect on several elements that one on a part of these explains as much.

    Args:
        base: The fitted baseline.
        accepted: Candidates with their evidence.
        cfg: Settings.
        slack: Factor on both bounds.
    """
    best = max(accepted, key=lambda pair: pair[1].gain)[0]
    group = []
    for c, f in accepted:
        rarer = best.effect.rarity - c.effect.rarity > _log_errors(base, c) - _log_errors(base, best)
        if rarer or _leaves_as_little(c, best, cfg, slack):
            group.append((c, f))
    group = [
        pair
        for pair in group
        if not any(_is_on_part(other, pair[0]) and _leaves_as_little(other, pair[0], cfg, slack) for other, _ in group)
    ]
    ranked = sorted(((_plausibility(base, *pair), pair) for pair in group), key=lambda found: -found[0])
    first, _ = ranked[0][1]
    return [
        (c, f)
        for place, (score, (c, f)) in enumerate(ranked)
        if not place
        or (
            score > ranked[0][0] - 2 * np.log(cfg.max_odds)
            and any(_leaves_as_little(c, other, cfg, slack) for other in (best, first))
            and not any(c.effect.has_as_special_case(other.effect) for other, _ in group)
        )
    ]


def equal_at_noise(
    base: FittedModel,
    group: Sequence[tuple[FittedCandidate, Finding]],
    accepted: Sequence[tuple[FittedCandidate, Finding]],
    cfg: SearchCfg,
) -> list[tuple[FittedCandidate, Finding]]:
    """Return a group with those that leave no more than noise, as its first does, and are nearly as plausible.

    Beside nominal values how much either leaves of so little is weak evidence: those that are fitted are what shows
    beside one of them. Odds decide, as between the answers of two searches.

    Args:
        base: The fitted baseline.
        group: What `indistinguishable` returned.
        accepted: All that it may have.
        cfg: Settings.
    """
    first, found = group[0], list(group)
    if first[0].ratio > cfg.explained_ratio:
        return found
    least = _plausibility(base, *first) - 2 * np.log(cfg.max_odds)
    for c, f in accepted:
        known = any(c is other for other, _ in found)
        special = any(c.effect.has_as_special_case(o.effect) or _is_on_part(o, c) for o, _ in found)
        if not (known or special) and c.ratio <= cfg.explained_ratio and _plausibility(base, c, f) > least:
            found.append((c, f))
    return found


def _is_on_part(one: FittedCandidate, other: FittedCandidate) -> bool:
    """Return whether a candidate is the effect of another one on some of its elements."""
    return one.effect.name == other.effect.name and set(one.effect.elements) < set(other.effect.elements)


def _leaves_as_little(c: FittedCandidate, other: FittedCandidate, cfg: SearchCfg, slack: float) -> bool:
    """Return whether the held-out error of a candidate exceeds another one's by no more than they may differ."""
    difference = c.errors - other.errors
    # A cost is half a sum of squares, an error a whole one.
    rough = 2 * np.hypot(c.cost_roughness, other.cost_roughness) if c is not other else 0.0
    error = np.hypot(np.sqrt(len(difference)) * difference.std(), rough)
    bound = max(cfg.equal_standard_errors * error, cfg.equal_error * other.errors.sum())
    return bool(difference.sum() <= slack * bound)


def leaves_more(errors: np.ndarray, least: np.ndarray, cfg: SearchCfg) -> bool:
    """Return whether the held-out errors of blocks, shape (B,), exceed the least ones by more than they may differ."""
    difference = errors - least
    error = np.sqrt(len(difference)) * difference.std()
    return bool(difference.sum() > max(cfg.equal_standard_errors * error, cfg.equal_error * least.sum()))


def _log_errors(base: FittedModel, c: FittedCandidate) -> float:
    """Return minus twice the log likelihood of a candidate, up to a constant: noise of unknown size, blocks of time."""
    return float(base.blocks.count * np.log(max(c.errors.sum(), 1e-12)))


def _plausibility(base: FittedModel, c: FittedCandidate, f: Finding) -> float:
    """Return twice the log posterior of a candidate, up to a constant.

    Schwarz's criterion with noise of unknown size, blocks of time as the observations (Annals of Statistics 6, 1978),
    a Cauchy prior of sizes, and the effect's rarity.
    """
    prediction = base.prediction(c.effect)
    added = prediction.parameters[prediction.owned :]
    return -_log_errors(base, c) - surprise(c.effect, added, [p.value for p in f.parameters], base.blocks.count)


def surprise(effect: Effect, parameters: Sequence[Parameter], values: Sequence[float], count: int) -> float:
    """Return minus twice the log prior of an effect, up to a constant: its rarity, number of parameters, and sizes.

    Joints and drives of a machine are alike. Where an effect acts on several, how large it is counts once, by the
    largest of them, not for each as if they had nothing to do with each other; what they differ by is in the number of
    parameters.

    Args:
        effect: The effect.
        parameters: Its parameters.
        values: Their values.
        count: Observations, for Schwarz's criterion.
    """
    largest, alike = {}, effect.kind in ("joint", "actuator")
    for p, size in zip(parameters, np.abs(_sizes(parameters, values)), strict=True):
        kind = p.name.partition("[")[0] if alike else p.name
        largest[kind] = max(largest.get(kind, 0.0), float(size))
    charge = 2 * sum(np.log1p(size**2) for size in largest.values())
    return float(charge + len(parameters) * np.log(count) + effect.rarity)


def largest_size(base: FittedModel, c: FittedCandidate) -> float:
    """Return the largest size of a candidate's own parameters, over their typical sizes [-].

    Args:
        base: The fitted baseline.
        c: The candidate.
    """
    prediction = base.prediction(c.effect)
    own = slice(prediction.owned, None)
    return float(np.abs(_sizes(prediction.parameters[own], c.fit.values[own])).max(initial=0.0))


def _sizes(parameters: Sequence[Parameter], values: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the differences of values from the null values over typical ones, shape (P,); 0 where null is infinite."""
    away = [v - p.null if np.isfinite(p.null) else 0.0 for v, p in zip(values, parameters, strict=True)]
    return np.array(away) / np.array([max(p.scale, p.typical) for p in parameters])


def detectable_size(base: FittedModel, s: ScreenedCandidate, share: float) -> Detectable | None:
    """Return the smallest size of a candidate that the search would have found in half of all cases.

    A parameter off its null value by x adds H x^2 to the error, which must exceed a share of it.

    Args:
        base: The fitted baseline.
        s: The candidate.
        share: Share of the held-out error that an effect must remove [-].
    """
    prediction = base.prediction(s.effect)
    normal = sum(piece.jacobian.T @ piece.jacobian for piece in s.pieces)
    needed = max(share, 0.0) * base.errors.sum()
    best = None
    for k in range(prediction.owned, len(prediction.parameters)):
        p, curvature = prediction.parameters[k], float(np.asarray(normal)[k, k])
        if np.isfinite(p.null) and curvature > 1e-12:
            size = p.scale * np.sqrt(needed / curvature)
            if size < p.high - p.low and (best is None or size / p.scale < best[0]):
                best = size / p.scale, Detectable(s.effect.name, p.name, float(size), p.unit, p.null)
    return None if best is None else best[1]
