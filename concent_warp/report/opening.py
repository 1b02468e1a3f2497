"""Where the charts and the replay of a report open: the channel farthest above its noise, at its largest error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from concent_warp.comparison.residuals import Residual
from concent_warp.comparison.result import Comparison


@dataclass(frozen=True)
class Opening:
    """What a demonstration is opened with."""

    channel: str
    time: float
    """[s]."""
    ratio: float
    """RMS error of the channel over its noise [-]; infinite where the model has diverged, 0 where noise is unknown."""


def openings(comparison: Comparison, demonstrations: Sequence[str]) -> dict[str, Opening]:
    """Return what each demonstration is opened with.

    Errors are those of the last model; of the first one where the last is nowhere above the noise.
    """
    last = {name: _opening(comparison, comparison.after, name) for name in demonstrations}
    if any(opening.ratio >= comparison.span_cfg.min_ratio for opening in last.values()):
        return last
    return {name: _opening(comparison, comparison.before, name) for name in demonstrations}


def first_demonstration(found: dict[str, Opening]) -> str:
    """Return the demonstration that a report opens with: the one with the largest ratio."""
    return max(found, key=lambda name: found[name].ratio)


def _opening(comparison: Comparison, model: str, demonstration: str) -> Opening:
    """Return the channel of a demonstration that is farthest above its noise, and when its error is largest."""
    best = Opening(comparison.main_channel(), 0.0, -1.0)
    for residual in comparison.residuals[model, demonstration]:
        measured = np.flatnonzero(~np.isnan(residual.error))
        if not len(measured):
            continue
        ratio = _noise_ratio(residual.weighted[measured], residual)
        if ratio > best.ratio:
            largest = measured[int(residual.error[measured].argmax())]
            best = Opening(residual.channel, float(residual.time[largest]), ratio)
    return best


def _noise_ratio(error: np.ndarray, residual: Residual) -> float:
    """Return the RMS of weighted errors (n,) over the noise floor [-], 0 where the noise is unknown."""
    if not np.isfinite(error).all():
        return float("inf")
    return float(np.sqrt(np.mean(error**2)) / residual.noise) if residual.noise else 0.0
