"""Units that a map may name, and what they are in SI."""

from __future__ import annotations

import math
import re
from typing import Literal

Quantity = Literal[
    "angle", "length", "angular velocity", "velocity", "acceleration", "angular acceleration", "force", "torque",
    "orientation", "any",
]  # fmt: skip
"""What a sensor or actuator has; any where its unit cannot be told."""
UNITS: dict[str, tuple[Quantity, float]] = {
    "rad": ("angle", 1.0),
    "deg": ("angle", math.pi / 180),
    "turn": ("angle", 2 * math.pi),
    "m": ("length", 1.0),
    "cm": ("length", 1e-2),
    "mm": ("length", 1e-3),
    "um": ("length", 1e-6),
    "inch": ("length", 0.0254),
    "rad/s": ("angular velocity", 1.0),
    "deg/s": ("angular velocity", math.pi / 180),
    "rpm": ("angular velocity", math.pi / 30),
    "m/s": ("velocity", 1.0),
    "mm/s": ("velocity", 1e-3),
    "m/s^2": ("acceleration", 1.0),
    "g": ("acceleration", 9.80665),
    "rad/s^2": ("angular acceleration", 1.0),
    "deg/s^2": ("angular acceleration", math.pi / 180),
    "N": ("force", 1.0),
    "mN": ("force", 1e-3),
    "Nm": ("torque", 1.0),
    "mNm": ("torque", 1e-3),
}
"""Quantity and factor to SI, by name."""
SHARES: dict[str, tuple[float, float]] = {
    "share": (0.0, 1.0),
    "percent": (0.0, 100.0),
    "signed_percent": (-100.0, 100.0),
}
"""Values at the two ends of the range of a joint or actuator, by name of the unit."""
SI: dict[Quantity, str] = {
    "angle": "rad",
    "length": "m",
    "angular velocity": "rad/s",
    "velocity": "m/s",
    "acceleration": "m/s^2",
    "angular acceleration": "rad/s^2",
    "force": "N",
    "torque": "Nm",
    "orientation": "",
    "any": "",
}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
DEPTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "100um": 1e-4, "um": 1e-6}
"""Units of depth; RealSense's D405 counts in 100 um."""
_SPELLINGS: dict[str, dict[Quantity, str]] = {
    "mm millimeter millimeters millimetre millimetres": {"length": "mm", "velocity": "mm/s"},
    "cm centimeter centimeters centimetre centimetres": {"length": "cm"},
    "um": {"length": "um"},
    "inch inches": {"length": "inch"},
    "deg degs degree degrees": {"angle": "deg", "angular velocity": "deg/s"},
    "dps": {"angular velocity": "deg/s"},
    "rpm": {"angular velocity": "rpm"},
    "mnm": {"torque": "mNm"},
}
NAMED = {word: units for spellings, units in _SPELLINGS.items() for word in spellings.split()}
"""Units that are not SI by the words at the end of a channel's name that state them, in lower case."""
SI_WORDS = ("rad", "rads", "radian", "radians", "nm", "mps", "meters", "metres")
"""Words at the end of a name that state units of SI."""


def words_of(name: str) -> list[str]:
    """Return the words of a name in lower case; camelCase is parted."""
    parted = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", name)
    return [word for word in re.split(r"[^a-z0-9]+", parted.lower()) if word]


def named_unit(name: str, quantity: Quantity) -> str | None:
    """Return the unit, not of SI, that the name of a channel states for a quantity: ``mm`` of ``stage/pos_mm``.

    The last word of the name that states one counts, or those of what is before it, such as a file.
    """
    ends = [words[-1] for part in re.split(r"[/.]", name) if (words := words_of(part))]
    said = next((end for end in reversed(ends) if end in SI_WORDS or quantity in NAMED.get(end, {})), "")
    return NAMED.get(said, {}).get(quantity)
