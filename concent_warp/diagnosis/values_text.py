"""Fitted values in the words of an answer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from concent_warp.comparison.units import interval_texts, readable_step
from concent_warp.effects.effect import with_unit
from concent_warp.fit.effects.intervals import FittedParameter

SCATTER_CLAUSE = (
    "the scatter of simulated contacts over a time step counts as noise here; `compare` counts it as error, and may "
    "show more"
)
"""What is added to residuals over noise that rest on this scatter."""
MOST_PARAMETERS = 4
"""Parameters of an effect in a sentence."""
FACTOR_DECIMALS, MOST_DECIMALS = 3, 6
"""Decimals of a factor: at least, and at most where its interval is narrow."""
VISIBLE_FACTOR, VISIBLE_DELAY = 5e-4, 5e-6
"""Changes of a factor [-] and of a latency [s] that show when rounded, to three decimals and to 0.01 ms."""


def parameters_text(parameters: Sequence[FittedParameter]) -> str:
    """Return parameters of an effect with their intervals.

    Where some of them exclude the null value, the others are only counted.
    """
    telling = [p for p in parameters if p.excludes_null]
    named = (telling or list(parameters))[:MOST_PARAMETERS]
    told = [_parameter_text(p) for p in named]
    if more := len(telling or parameters) - len(named):
        told.append(f"{more} more")
    if telling and (same := len(parameters) - len(telling)):
        told.append(f"{same} more {'includes' if same == 1 else 'include'} no change")
    return ", ".join(told)


def nominal_sentence(values: Sequence[FittedParameter]) -> str:
    """Return a sentence on nominal values that were fitted: those that changed visibly, and how many did not."""
    changed = [p for p in values if _changed(p)]
    rest = len(values) - len(changed)
    if not changed:
        return f"Nominal values were fitted within their tolerances; none of {rest} changed visibly."
    shown = ", ".join(_factor_text(p) if p.unit == "-" else _parameter_text(p, 2) for p in changed)
    others = f"; {rest} {'other' if rest == 1 else 'others'} did not change visibly" if rest else ""
    return f"Nominal values were fitted within their tolerances: {shown}{others}."


def _changed(p: FittedParameter) -> bool:
    """Return whether a nominal value differs visibly from the one that was given, or its interval excludes that."""
    visible = VISIBLE_FACTOR if p.unit == "-" else VISIBLE_DELAY
    return p.excludes_null or abs(p.value - p.null) >= visible


def _parameter_text(p: FittedParameter, digits: int = 3) -> str:
    """Return a parameter with its interval, such as "torque[hinge] 0.03 [0.029, 0.031] N m"."""
    value, low, high = interval_texts(p.value, p.low, p.high, digits)
    return with_unit(f"{p.name} {value} [{low}, {high}]", p.unit)


def _factor_text(p: FittedParameter) -> str:
    """Return a factor on a nominal value with its interval, such as "mass[arm] x 1.012 [1.010, 1.015]"."""
    step = readable_step(p.value, p.low, p.high)
    decimals = FACTOR_DECIMALS
    if step > 0:
        decimals = int(np.clip(-np.floor(np.log10(step)), FACTOR_DECIMALS, MOST_DECIMALS))
    return f"{p.name} x {p.value:.{decimals}f} [{p.low:.{decimals}f}, {p.high:.{decimals}f}]"
