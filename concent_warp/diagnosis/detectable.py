"""The smallest size of an effect that a recording would reveal, and its words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from concent_warp.comparison.units import number_text

DETECTABLE_MEANING = (
    "from there on an effect would be noticed, were nothing else wrong; not how exactly its size would be known"
)
"""What the sizes mean."""


@dataclass(frozen=True)
class Detectable:
    """The smallest size of an effect that this recording would reveal."""

    name: str
    parameter: str
    size: float
    """Difference from the null value, in `unit`."""
    unit: str
    null: float = 0.0
    """Value at which the effect does nothing."""

    def to_json(self) -> dict[str, Any]:
        """Return it in plain types."""
        size, null = (float(x) if np.isfinite(x) else None for x in (self.size, self.null))
        return {"name": self.name, "parameter": self.parameter, "size": size, "unit": self.unit, "null": null}


def detectable_text(name: str, parameter: str, size: float, unit: str, null: float) -> tuple[str, str, str]:
    """Return the name of an effect with its parameter, a size, and the unit of that.

    Sizes without unit are shares of the model's value in percent, where that is not zero. A parameter that only repeats
    the effect's name is left out.

    Args:
        name: Name of the effect.
        parameter: Name of its parameter.
        size: Smallest detectable difference from the null value, in `unit`.
        unit: SI unit, "-" for none.
        null: Value at which the effect does nothing.
    """
    bare = parameter.split("[")[0]
    repeated = f"_{name.split('(')[0]}".endswith(f"_{bare}")
    rest = parameter.removeprefix(bare) if repeated else f" {parameter}"
    if unit == "-" and null:
        return f"{name}{rest}", number_text(100 * size / abs(null), 2), "% of the model's"
    return f"{name}{rest}", number_text(size, 2), "(no unit)" if unit == "-" else unit


def detectable_sentence(found: Sequence[Detectable]) -> str:
    """Return a sentence on the smallest detectable sizes of effects."""
    shown = "; ".join(" ".join(detectable_text(d.name, d.parameter, d.size, d.unit, d.null)) for d in found)
    return f"Smallest detectable sizes ({DETECTABLE_MEANING}): {shown}."
