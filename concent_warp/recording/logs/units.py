"""Units that a map may name, and what they are in SI."""

from __future__ import annotations

import math
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
