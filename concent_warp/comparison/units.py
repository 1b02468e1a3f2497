"""How quantities are shown to people: lengths in mm, angles in degrees, channels in words."""

from __future__ import annotations

import numpy as np

DISPLAY_UNITS = {"m": (1e3, "mm"), "rad": (180 / np.pi, "°"), "m/s": (1e3, "mm/s"), "rad/s": (180 / np.pi, "°/s")}
"""Factor and unit in which a unit is shown to people."""
MOST_DIGITS = 9
"""Most significant digits of a number [-]."""


def value_text(value: float | None, unit: str, *, sign: bool = False) -> str:
    """Return a number in the unit in which it is shown, without the unit's name."""
    if value is None or np.isnan(value):
        return "-"
    if np.isinf(value):
        return "diverged"
    value *= DISPLAY_UNITS.get(unit, (1, unit))[0]
    digits = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 2 if abs(value) >= 0.1 else 3
    return f"{value:{'+' if sign else ''}.{digits}f}"


def number_text(value: float, digits: int = 3, step: float = 0.0) -> str:
    """Return a number with so many significant digits, more where they are before the point or needed for `step`.

    From 1e-4 up to a million it has no exponent.
    """
    if not value or not np.isfinite(value):
        return f"{value:g}"
    leading = int(f"{value:.{digits - 1}e}".split("e")[1])
    digits = max(digits, leading + 1) if leading < 6 else digits
    if step > 0:
        digits = max(digits, min(leading - int(np.floor(np.log10(step))) + 1, MOST_DIGITS))
    return f"{value:.{digits}g}"


def readable_step(value: float, low: float, high: float) -> float:
    """Return the difference that must be seen in a value and the ends of its interval: a power of ten, 0 for any.

    It is at most half of the interval's half width; of an interval that is open on one side, of the other one.
    """
    ends = [end for end in (low, high) if np.isfinite(end)]
    reach = (high - low) / 2 if len(ends) == 2 else max((abs(value - end) for end in ends), default=0.0)
    return float(10.0 ** np.floor(np.log10(reach / 2))) if np.isfinite(reach) and reach > 0 else 0.0


def interval_texts(value: float, low: float, high: float, digits: int = 3) -> tuple[str, str, str]:
    """Return a value and the ends of its interval, with digits enough to tell them apart."""
    step = readable_step(value, low, high)
    return number_text(value, digits, step), number_text(low, digits, step), number_text(high, digits, step)


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
