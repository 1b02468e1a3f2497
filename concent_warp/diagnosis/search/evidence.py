"""What speaks for a fitted effect: its parameters with intervals, what it removes, and which others do as well."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from concent_warp.diagnosis.result import Detectable, Finding
from concent_warp.diagnosis.search.steps import Candidate, FittedModel, Screened
from concent_warp.fit.effects.intervals import FittedParameter, covariance, law_errors
from concent_warp.fit.effects.prediction import Prediction

SAME = 0.02
"""Errors that differ by less than this share are taken for the same."""


def fitted_parameters(base: FittedModel, c: Candidate) -> tuple[FittedParameter, ...]:
    """Return the parameters of a candidate with their 95 % intervals (normal, robust to correlation in blocks).

    With the law's own error, see `law_errors`.
    """
    prediction = Prediction(base.model, (c.effect,), base.windows, engine=base.engine)
    spread = np.sqrt(np.diag(covariance(c.sums, base.blocks))) if c.spread is None else c.spread
    fresh = range(prediction.owned, len(prediction.parameters))
    law = law_errors([prediction.parameters[k] for k in fresh], c.fit.values[prediction.owned :])
    found = []
    for k in fresh:
        p, value = prediction.parameters[k], float(c.fit.values[k])
        reach = 1.96 * np.hypot(spread[k] * p.scale, law[k - prediction.owned])
        low, high = max(value - reach, p.low), min(value + reach, p.high)
        bound = [b for b in (p.low, p.high) if abs(b - p.null) > 1e-3 * p.scale]
        at_bound = any(abs(value - b) < 1e-3 * p.scale for b in bound)
        found.append(FittedParameter(p.name, value, float(low), float(high), p.unit, p.null, at_bound))
    return tuple(found)


def removed(base: FittedModel, c: Candidate) -> tuple[tuple[str, float], ...]:
    """Return by how much the squared residual of each channel falls, as a share, most first."""
    before: dict[str, float] = {}
    after: dict[str, float] = {}
    for window, old, new in zip(base.windows, base.pieces, c.pieces, strict=True):
        for r in window.readings:
            before[r.channel] = before.get(r.channel, 0.0) + float(np.sum(old.residual[r.rows] ** 2))
            after[r.channel] = after.get(r.channel, 0.0) + float(np.sum(new.residual[r.rows] ** 2))
    shares = {name: 1.0 - after[name] / max(value, 1e-12) for name, value in before.items()}
    return tuple(sorted(((n, s) for n, s in shares.items() if s > 0), key=lambda pair: -pair[1]))


def alike(
    base: FittedModel, good: Sequence[tuple[Candidate, Finding]], slack: float = 1.0
) -> list[tuple[Candidate, Finding]]:
    """Return the accepted candidates that the data cannot tell from the best, the likeliest first.

    They are where what they leave differs by less than 2 standard errors, over the blocks and by the roughness of the
    costs, or by `SAME` of it; by `slack` times that. And where the best is so much rarer that this outweighs what the
    other leaves more: a law that is close to the missing one may fit a little better than it, as simulations of one
    law differ too. Among them those come first that leave less, need fewer parameters and smaller values of them, see
    `_plausibility`.
    """
    best = max(good, key=lambda pair: pair[1].gain)[0]
    group = []
    for c, f in good:
        difference = c.errors - best.errors
        # A cost is half a sum of squares, an error a whole one.
        rough = 2 * np.hypot(c.rough, best.rough) if c is not best else 0.0
        error = np.hypot(np.sqrt(len(difference)) * difference.std(), rough)
        rarer = best.effect.rarity - c.effect.rarity > _log_errors(base, c) - _log_errors(base, best)
        if rarer or difference.sum() <= slack * max(2 * error, SAME * best.errors.sum()):
            group.append((c, f))
    return sorted(group, key=lambda pair: -_plausibility(base, *pair))


def _log_errors(base: FittedModel, c: Candidate) -> float:
    """Return minus twice the log likelihood of a candidate, up to a constant: noise of unknown size, blocks of time."""
    return float(base.blocks.count * np.log(max(c.errors.sum(), 1e-12)))


def _plausibility(base: FittedModel, c: Candidate, f: Finding) -> float:
    """Return twice the log posterior of a candidate, up to a constant.

    Schwarz's criterion with noise of unknown size, blocks of time as the observations (Annals of Statistics 6, 1978),
    a Cauchy prior of sizes, and how rare the effect is.
    """
    prediction = Prediction(base.model, (c.effect,), base.windows, engine=base.engine)
    scale = np.array([p.scale for p in prediction.parameters[prediction.owned :]])
    away = np.array([(p.value - p.null) if np.isfinite(p.null) else 0.0 for p in f.parameters]) / scale
    fit = -_log_errors(base, c) - len(scale) * np.log(base.blocks.count)
    return float(fit - 2 * np.log1p(away**2).sum() - c.effect.rarity)


def detectable_size(base: FittedModel, s: Screened, share: float) -> Detectable | None:
    """Return the smallest size of a candidate that the search would have found in half of all cases.

    A parameter off its null value by x adds H x^2 to the error, of which it must be more than a share.
    """
    prediction = Prediction(base.model, (s.effect,), base.windows, engine=base.engine)
    normal = sum(piece.jacobian.T @ piece.jacobian for piece in s.pieces)
    needed = max(share, 0.0) * base.errors.sum()
    best = None
    for k in range(prediction.owned, len(prediction.parameters)):
        p, curvature = prediction.parameters[k], float(np.asarray(normal)[k, k])
        if np.isfinite(p.null) and curvature > 1e-12:
            size = p.scale * np.sqrt(needed / curvature)
            if size < p.high - p.low and (best is None or size / p.scale < best[0]):
                best = size / p.scale, Detectable(s.effect.name, p.name, float(size), p.unit)
    return None if best is None else best[1]
