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
_SPELLINGS: dict[str, str] = {
    "rad": "rad rads radian radians",
    "deg": "deg degs degree degrees",
    "turn": "turn turns rev revs revolution revolutions",
    "m": "m meter meters metre metres",
    "cm": "cm centimeter centimeters centimetre centimetres",
    "mm": "mm millimeter millimeters millimetre millimetres",
    "um": "um micron microns micrometer micrometers micrometre micrometres",
    "inch": "inch inches",
    "rad/s": "radps",
    "deg/s": "dps degps",
    "rpm": "rpm",
    "m/s": "mps ms",
    "mm/s": "mmps",
    "m/s^2": "mps2 ms2",
    "g": "g",
    "N": "n newton newtons",
    "mN": "mn millinewton millinewtons",
    "Nm": "nm",
    "mNm": "mnm",
    "percent": "percent pct",
    "share": "share",
}
"""Words at the end of a name that state a unit, in lower case."""
WEAK_WORDS = ("m", "g", "n", "ms", "turn", "turns", "rev", "revs", "share")
"""Words that say other things, too: they state a unit behind other words, for what has this unit."""
UNIT_WORDS = frozenset(word for words in _SPELLINGS.values() for word in words.split()) - {*WEAK_WORDS}
"""Words that state a unit wherever they are in a name."""
SECOND = ("s", "sec", "second")
RATES: dict[tuple[str, Quantity], str] = {
    ("rad", "angular velocity"): "rad/s",
    ("deg", "angular velocity"): "deg/s",
    ("m", "velocity"): "m/s",
    ("mm", "velocity"): "mm/s",
    ("rad", "angular acceleration"): "rad/s^2",
    ("deg", "angular acceleration"): "deg/s^2",
}
"""Units of rates that names shorten: ``speed_deg`` is in deg/s."""
MOST_WORDS = 4
"""Most words that state a unit, as in ``m per s 2``."""


def _endings() -> dict[tuple[str, ...], str]:
    """Return units by the words at the end of a name that state them, such as deg/s by deg and s."""
    found = {(word,): unit for unit, words in _SPELLINGS.items() for word in words.split()}
    found |= {("n", "m"): "Nm", ("mn", "m"): "mNm", ("signed", "percent"): "signed_percent"}
    found |= {("rev", "min"): "rpm", ("rev", "per", "min"): "rpm"}
    for unit in ("rad", "deg", "m", "mm"):
        for word in _SPELLINGS[unit].split():
            for per in ((word,), (word, "per")):
                found |= {(*per, second): f"{unit}/s" for second in SECOND}
                if f"{unit}/s^2" in UNITS:
                    found |= {(*per, *squared): f"{unit}/s^2" for squared in (("s2",), ("s", "2"))}
    return found


ENDINGS = _endings()


def words_of(name: str) -> list[str]:
    """Return the words of a name in lower case; camelCase is parted."""
    parted = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", name)
    return [word for word in re.split(r"[^a-z0-9]+", parted.lower()) if word]


def parted_unit(name: str) -> tuple[list[str], str]:
    """Return the words of a name before the unit at its end, and that unit: ``stage, pos`` and ``mm`` of
    ``stage/pos_mm``. Without a unit these are all words and an empty text.
    """
    spans = list(re.finditer(r"[a-z0-9]+", name.lower())) if len(name.lower()) == len(name) else []
    whole = [hit[0] for hit in spans]  # the unit of torque_mNm is one word
    for words in (whole, words_of(name)):
        for count in range(min(MOST_WORDS, len(words)), 0, -1):
            end = tuple(words[-count:])
            if end in ENDINGS and (end[-1] not in WEAK_WORDS or len(words) > count):
                return words_of(name[: spans[-count].start()]) if words is whole else words[:-count], ENDINGS[end]
    return words_of(name), ""


def stated_unit(name: str, quantity: Quantity) -> str | None:
    """Return the unit that the name of a channel states for a quantity: ``mm`` of ``stage/pos_mm``.

    The end of the name counts, or, where that states none, the end of what is before it, such as a file.
    """
    ends = [len(name), *(hit.start() for hit in reversed(list(re.finditer(r"[/.]", name))))]
    return next((unit for end in ends if (unit := _fitting(name[:end], quantity))), None)


def named_unit(name: str, quantity: Quantity) -> str | None:
    """Return the unit, not of SI, that the name of a channel states for a quantity, as `stated_unit`."""
    unit = stated_unit(name, quantity)
    return None if unit in SI.values() else unit


def contrary_unit(name: str, quantity: Quantity) -> str | None:
    """Return the unit at the end of a name that is none of a quantity: ``rpm`` of ``motor_rpm`` for a torque."""
    if quantity in ("any", "orientation") or is_weak(name):
        return None
    unit = parted_unit(name)[1]
    return unit if unit and not _fitting(name, quantity) else None


def _fitting(name: str, quantity: Quantity) -> str:
    """Return the unit at the end of a name, empty where there is none or it is none of the quantity."""
    unit = parted_unit(name)[1]
    if unit in SHARES:
        return "" if quantity == "orientation" else unit
    if not unit or (quantity == "any" and is_weak(name)):
        return ""
    return unit if quantity in (UNITS[unit][0], "any") else RATES.get((unit, quantity), "")


def is_weak(name: str) -> bool:
    """Return whether what seems to be a unit at the end of a name may say other things."""
    words, unit = parted_unit(name)
    return bool(unit) and len(words) == len(words_of(name)) - 1 and words_of(name)[-1] in WEAK_WORDS
