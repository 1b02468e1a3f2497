"""A look at the data themselves before anything is blamed on the model."""

from __future__ import annotations

import numpy as np

from concent_warp.recording.recording import Recording

GAP = 10.0
"""A pause this many times the usual time between samples is a gap."""
WHITE = 0.8
"""Mean squared step from sample to sample over twice the variance: 1 for noise, much less for motion (von Neumann,
"Distribution of the ratio of the mean square successive difference to the variance", Ann. Math. Stat. 12, 1941)."""
ENOUGH = 30
"""Samples from which on noise is told from motion."""
SCATTER = 3.0
"""Readings that scatter this many times as much as their stated noise do not only stand still."""
MISSING = 0.2
"""Share of missing samples that is worth a word."""


def check_data(recording: Recording) -> list[str]:
    """Return one sentence on each thing in a recording that looks wrong: gaps, missing samples, channels that stand."""
    found = []
    for d in recording.demonstrations:
        alone = len(d.measured) == 1
        for name, channel in d.measured.items():
            where = f"{d.name}, {name}"
            if len(channel.time) < 2:
                found.append(f"{where}: only {len(channel.time)} sample, which says nothing.")
                continue
            steps = np.diff(channel.time)
            usual = float(np.median(steps))
            if (long := steps > GAP * usual).any():
                found.append(
                    f"{where}: {int(long.sum())} gaps of up to {steps.max():.3g} s between samples {usual:.3g} s apart."
                )
            known = np.isfinite(channel.value).all(axis=1)
            if (share := 1 - known.mean()) > MISSING:
                found.append(f"{where}: {100 * share:.0f} % of the samples are missing.")
            values = channel.value[known]
            if len(values) > 10 and np.ptp(values, axis=0).max() == 0.0:
                found.append(f"{where}: the reading never changes.")
            stated = channel.noise_std
            beyond = alone if stated is None else values.std(axis=0).max(initial=0.0) > SCATTER * stated
            if beyond and _like_noise(values):
                found.append(f"{where}: the readings scatter like noise, no motion shows in them.")
    return found


def _like_noise(values: np.ndarray) -> bool:
    """Return whether readings (T, dim) change from sample to sample as much as if each were drawn by itself."""
    if len(values) < ENOUGH:
        return False
    variance = values.var(axis=0)
    moving = variance > 0
    step = np.mean(np.diff(values, axis=0) ** 2, axis=0)
    return bool(moving.any() and (step[moving] > 2 * WHITE * variance[moving]).all())
