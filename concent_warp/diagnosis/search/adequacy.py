"""Whether a fitted model leaves no more than noise, channel by channel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.estimation.noise import Noise
from concent_warp.estimation.noise_ratio import noise_ratio
from concent_warp.fit.effects.robust import huber, robust_noise_ratio


def channel_residuals(base: FittedModel) -> dict[str, np.ndarray]:
    """Return the residuals of each channel in units of its noise, initial states eliminated, each (n,)."""
    found: dict[str, list[np.ndarray]] = {}
    for window, piece in zip(base.windows, base.pieces, strict=True):
        for r in window.readings:
            found.setdefault(r.channel, []).append(piece.residual[r.rows])
    return {channel: np.concatenate(parts) for channel, parts in found.items()}


def is_adequate(base: FittedModel, noise_factors: Mapping[str, float], cfg: DiagnoseCfg) -> bool:
    """Return whether residuals are no larger than the noise may be, altogether and in each channel.

    Args:
        base: The fitted model.
        noise_factors: By how much the noise of each channel may be larger than its estimate, 1 where it is stated [-].
        cfg: Settings.
    """
    robust, scaled = base.cfg.least_squares.robust, _scaled(base, noise_factors)
    worst = max(robust_noise_ratio([r], robust) for r in scaled)
    return robust_noise_ratio(scaled, robust) <= cfg.adequate_ratio and worst <= cfg.adequate_channel_ratio


def least_ratio(base: FittedModel, noise_factors: Mapping[str, float]) -> float:
    """Return the residual of a fitted model over the noise [-], that as large as it may be.

    Args:
        base: The fitted model.
        noise_factors: By how much the noise of each channel may be larger than its estimate, 1 where it is stated [-].
    """
    return robust_noise_ratio(_scaled(base, noise_factors), base.cfg.least_squares.robust)


def is_near_noise(base: FittedModel, noise_factors: Mapping[str, float], cfg: DiagnoseCfg) -> bool:
    """Return whether a fitted model leaves little more than noise, see `SearchCfg.explained_ratio`.

    Args:
        base: The fitted model.
        noise_factors: By how much the noise of each channel may be larger than its estimate, 1 where it is stated [-].
        cfg: Settings.
    """
    return least_ratio(base, noise_factors) <= cfg.search.explained_ratio


def rests_on_scatter(base: FittedModel, cfg: DiagnoseCfg) -> bool:
    """Return whether residuals are no larger than noise only because numerical scatter counts as such.

    The numerical scatter of simulated contacts counts as noise (`Window.scatter`): a model may explain the data down to
    both together where it is far above the noise of the instruments. Residuals are those of the fitted initial states.

    Args:
        base: The fitted model.
        cfg: Settings.
    """
    if all(w.scatter is None for w in base.windows):
        return False
    found = [w.without_scatter(one.residual) for w, one in zip(base.windows, base.fit.linear, strict=True)]
    alone = base.noise_scale * noise_ratio(np.concatenate(found))
    return bool(base.noise_ratio <= cfg.adequate_ratio < alone)


def hidden_by_noise(base: FittedModel, noises: Mapping[str, Noise], cfg: DiagnoseCfg) -> str | None:
    """Return a sentence where what a model explains down to the noise is well above the least noise that may be.

    Args:
        base: The fitted model.
        noises: Noise of each channel that is not stated.
        cfg: Settings.
    """
    if base.ratio > cfg.adequate_ratio:
        return None
    least = {channel: max(noise.low / noise.std, 1e-3) for channel, noise in noises.items() if noise.std > 0}
    largest = robust_noise_ratio(_scaled(base, least), base.cfg.least_squares.robust)
    if largest <= cfg.form_error_ratio:
        return None
    return (
        f"With the least noise that these readings allow, residuals are {largest:.2g} x noise: what is missing may be "
        "hidden by the estimate. State the noise, of encoders their resolution / sqrt(12), and diagnose again."
    )


def qualified_by_noise(found: Diagnosis, base: FittedModel, noises: Mapping[str, Noise], cfg: DiagnoseCfg) -> Diagnosis:
    """Return a diagnosis that says where what is missing may be hidden by the noise.

    By noise that is too uncertain (`hidden_by_noise`), or by the scatter of simulations (`rests_on_scatter`).

    Where a replay in one piece is far off as well, no effect is named: neither windows nor replay speak for one.

    Args:
        found: The diagnosis.
        base: The last fitted model.
        noises: Noise of each channel that is not stated.
        cfg: Settings.
    """
    if rests_on_scatter(base, cfg):
        found = replace(found, rests_on_scatter=True)
    hidden = hidden_by_noise(base, noises, cfg)
    if hidden is None or found.verdict not in ("none_needed", "effect", "group"):
        return found
    doubtful = found.replayed is not None and found.replayed.doubtful
    verdict = "unsettled" if doubtful else found.verdict
    return replace(found, issues=(*found.issues, hidden), verdict=verdict)


def is_lacking(base: FittedModel, noise_factors: Mapping[str, float], cfg: DiagnoseCfg) -> bool:
    """Return whether the residual beyond what the noise may be is as much as an effect must remove.

    Args:
        base: The fitted model.
        noise_factors: By how much the noise of each channel may be larger than its estimate, 1 where it is stated [-].
        cfg: Settings.
    """
    return least_ratio(base, noise_factors) ** 2 >= 1 + cfg.min_gain


def _scaled(base: FittedModel, noise_factors: Mapping[str, float]) -> list[np.ndarray]:
    """Return the residuals of each channel in units of the largest noise that it may have, each (n,)."""
    return [base.noise_scale * r / noise_factors.get(c, 1.0) for c, r in channel_residuals(base).items()]


def discrepancies(base: FittedModel, first: FittedModel) -> tuple[float, float]:
    """Return the mean squared residuals beyond the noise, over the squared noise, of a model and of the first one [-].

    A residual counts as an outlier, by Huber's loss, only where the model leaves it: large
    residuals of the first one alone, of an effect that acts now and then, are what the model explains. Where the two
    have different windows, each has its own outliers.

    Args:
        base: The fitted model.
        first: The fitted model as given.
    """
    after, before = (np.concatenate([piece.residual for piece in one.pieces]) for one in (base, first))
    same = len(after) == len(before)
    outlier = np.abs(after) > base.limit if same else np.abs(before) > first.limit
    left = float(np.mean(2 * huber(after, base.limit)))
    limit = base.limit if same else first.limit
    lacked = float(np.mean(np.where(outlier, 2 * huber(before, limit), before**2)))
    return base.noise_scale**2 * left - 1.0, first.noise_scale**2 * lacked - 1.0
