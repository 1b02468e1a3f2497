"""A look at the data themselves before anything is blamed on the model."""

from __future__ import annotations

import numpy as np

from concent_warp.recording.recording import Recording

GAP = 10.0
"""A pause this many times the usual time between samples is a gap."""
MISSING = 0.2
"""Share of missing samples that is worth a word."""


def check_data(recording: Recording) -> list[str]:
    """Return one sentence on each thing in a recording that looks wrong: gaps, missing samples, channels that stand."""
    found = []
    for d in recording.demonstrations:
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
    return found
