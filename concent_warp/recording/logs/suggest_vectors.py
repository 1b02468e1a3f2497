"""Channels that are the components of a vector or a quaternion, for a first map: `x`, `y`, `z` and `qx` ... `qw`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from concent_warp.recording.logs.readers.log import Signal
from concent_warp.recording.logs.targets import Target
from concent_warp.recording.logs.units import NAMED, SI_WORDS, named_unit, words_of

AXES = {3: "xyz", 4: "xyzw"}
"""Components by their number; a log has w last, unless its map says otherwise."""


@dataclass(frozen=True)
class VectorChoice:
    """Channels for a sensor of several numbers."""

    target: Target
    sources: tuple[str, ...]
    unit: str | None
    """Unit that their names state."""
    guess: bool
    """Whether nothing but their number says that they are the sensor's."""


def vector_choices(targets: Iterable[Target], signals: Sequence[Signal]) -> list[VectorChoice]:
    """Return channels for sensors of positions and orientations, by the body in their names, or the only ones.

    Args:
        targets: Sensors of several numbers.
        signals: Measured channels that are not taken.
    """
    found: list[VectorChoice] = []
    wanted = [one for one in targets if one.quantity in ("length", "orientation") and one.size in AXES]
    for target in wanted:
        axes = AXES[target.size]
        groups = _groups(signals, axes, quaternion=target.size == len("xyzw"))
        named = [stem for stem in groups if {*words_of(target.joint)} <= {*stem} and target.joint]
        alone = len(groups) == 1 == sum(other.size == target.size for other in wanted)
        if stems := named[:1] or (list(groups) if alone else []):
            sources = tuple(groups[stems[0]][axis] for axis in axes)
            unit = named_unit(sources[0], target.quantity)
            found.append(VectorChoice(target, sources, unit, guess=not named))
    return found


def _groups(signals: Sequence[Signal], axes: str, *, quaternion: bool) -> Mapping[tuple[str, ...], Mapping[str, str]]:
    """Return the names of channels that differ in their components alone, by component, by what they share."""
    found: dict[tuple[str, ...], dict[str, str]] = {}
    for one in signals:
        words = words_of(one.name)
        while words and (words[-1] in NAMED or words[-1] in SI_WORDS):
            words.pop()
        if words and words[-1] in {*axes, *(f"q{axis}" for axis in axes if quaternion)}:
            stem = (*words[:-1], *("q" for _ in range(len(words[-1]) - 1)))
            found.setdefault(stem, {})[words[-1][-1]] = one.name
    return {stem: names for stem, names in found.items() if set(names) == set(axes)}
