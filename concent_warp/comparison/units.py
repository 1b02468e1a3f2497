"""How quantities are shown to people: lengths in mm, angles in degrees, channels in words."""

from __future__ import annotations

import numpy as np

DISPLAY_UNITS = {"m": (1e3, "mm"), "rad": (180 / np.pi, "°"), "m/s": (1e3, "mm/s"), "rad/s": (180 / np.pi, "°/s")}
"""Factor and unit in which a unit is shown to people."""


def value_text(value: float | None, unit: str, *, sign: bool = False) -> str:
    """Return a number in the unit in which it is shown, without the unit's name."""
    if value is None or np.isnan(value):
        return "-"
    if np.isinf(value):
        return "diverged"
    value *= DISPLAY_UNITS.get(unit, (1, unit))[0]
    digits = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 2 if abs(value) >= 0.1 else 3
    return f"{value:{'+' if sign else ''}.{digits}f}"


def percent_text(share: float) -> str:
    """Return a relative change in whole percent with its sign."""
    whole = round(100 * share)
    return f"{whole:+d} %" if whole else "0 %"


def unit_text(unit: str) -> str:
    """Return the name of the unit in which a unit is shown."""
    return DISPLAY_UNITS.get(unit, (1, unit))[1]


def ratio_text(ratio: float) -> str:
    """Return a ratio with its cross, such as ``8 x``."""
    return f"{ratio:.1f} x" if ratio < 9.95 else f"{ratio:.0f} x" if ratio < 1000 else "over 1000 x"


def channel_text(channel: str) -> str:
    """Return a channel's name as words: ``block_position`` is "block position"."""
    return channel.replace("_", " ")


def p_value_text(p: float, smallest: float = 0.0) -> str:
    """Return a p-value as text, such as "p = 0.03", or "p <= 0.0025" at the smallest that its test can give.

    Args:
        p: The p-value.
        smallest: 1 / (n + 1) of a test with n random samples; 0 for a test without such a bound.
    """
    sign = "<=" if p <= smallest * (1 + 1e-9) else "="
    return f"p {sign} {p:.2g}"
