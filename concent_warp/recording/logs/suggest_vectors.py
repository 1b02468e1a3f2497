"""Channels that are the components of a vector or a quaternion, for a first map: `x`, `y`, `z` and `qx` ... `qw`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from concent_warp.recording.logs.readers.log import Signal
from concent_warp.recording.logs.targets import Target
from concent_warp.recording.logs.units import UNITS, named_unit, parted_unit, words_of

AXES = {3: "xyz", 4: "xyzw"}
"""Components by their number; a log has w last, unless its map says otherwise."""
BEFORE = {3: ("", "p", "t"), 4: ("", "q", "r", "o")}
"""Letters before a component, as in ``px``, ``tx`` and ``qw``, by the number of components."""
COMPONENT = re.compile(r"([a-z]?)([wxyz])")


@dataclass(frozen=True)
class VectorChoice:
    """Channels for a sensor of several numbers."""

    target: Target
    sources: tuple[str, ...]
    unit: str | None
    """Unit that their names state."""
    guess: str
    """Why it may be wrong; empty where names agree."""


def vector_choices(targets: Iterable[Target], signals: Sequence[Signal], room: float) -> list[VectorChoice]:
    """Return channels for sensors of positions and orientations, by the body in their names, or the only ones.

    Args:
        targets: Sensors of several numbers.
        signals: Measured channels that are not taken.
        room: Largest position that is taken for metres; what lies beyond is guessed to be in millimetres.
    """
    found: list[VectorChoice] = []
    wanted = [one for one in targets if one.quantity in ("length", "orientation") and one.size in AXES]
    for target in wanted:
        axes = AXES[target.size]
        groups = _groups(signals, axes)
        parts = [{*words_of(name)} for name in (target.joint, target.name) if name]
        named = [stem for stem in groups if any(words <= {*stem} for words in parts)]
        named.sort(key=len)  # what its name says beside the body may make it another thing
        alone = len(groups) == 1 == sum(other.size == target.size for other in wanted)
        if stems := named[:1] or (list(groups) if alone else []):
            sources = tuple(groups[stems[0]].get(axis, "") for axis in axes)
            first = next(filter(None, sources))
            unit, guesses = named_unit(first, target.quantity), [] if named else ["the only ones"]
            if "" in sources:
                guesses.append("not all components are in the log")
            values = np.concatenate([one.value for one in signals if one.name in sources])
            far = float(np.nanmax(np.abs(values), initial=0.0))
            if unit is None and target.quantity == "length" and far > room:
                unit = "mm"
                guesses.append(f"values up to {far:.4g}")
            found.append(VectorChoice(target, sources, unit, ", ".join(guesses)))
    return found


def _groups(signals: Sequence[Signal], axes: str) -> Mapping[tuple[str, ...], Mapping[str, str]]:
    """Return the names of channels that differ in their components alone, by component, by what they share.

    Of a position two components are enough, as of markers that one camera tracks.
    """
    found: dict[tuple[str, ...], dict[str, str]] = {}
    for one in signals:
        words, unit = parted_unit(one.name)
        if unit and UNITS.get(unit, ("",))[0] != "length":
            continue
        if words and (hit := COMPONENT.fullmatch(words[-1])):
            found.setdefault((*words[:-1], hit[1]), {})[hit[2]] = one.name
    # Those of a quaternion are four, so that x, y and z of one are no position.
    letters = BEFORE[len(axes)]
    least = len(axes) if len(axes) > 3 else 2
    return {
        stem: names
        for stem, names in found.items()
        if set(names) <= set(axes) and len(names) >= least and stem[-1] in letters
    }
