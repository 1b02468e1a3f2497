"""Channels that are the components of a vector or a quaternion, for a first map: `x`, `y`, `z` and `qx` ... `qw`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from concent_warp.recording.logs.channel_names import parsed
from concent_warp.recording.logs.left_over import entry_of
from concent_warp.recording.logs.readers.log import Signal
from concent_warp.recording.logs.suggest_matches import equally
from concent_warp.recording.logs.targets import Target
from concent_warp.recording.logs.units import RATES, UNITS, named_unit, parted_unit, words_of

AXES = {3: "xyz", 4: "xyzw"}
"""Components by their number; a log has w last, unless its map says otherwise."""
LETTERS = {
    "": ("length", "orientation"), "p": ("length",), "t": ("torque", "length"), "f": ("force",), "m": ("torque",),
    "v": ("velocity",), "w": ("angular velocity",), "g": ("angular velocity",), "a": ("acceleration",),
    "q": ("orientation",), "r": ("orientation",), "o": ("orientation",),
}  # fmt: skip
"""Quantities by the letter before a component, as in ``px``, ``tx`` and ``qw``."""
SAID = {
    "length": "pos position positions translation",
    "orientation": "q quat quaternion orientation rotation",
    "force": "force forces",
    "torque": "torque torques moment moments tau",
    "acceleration": "acc accel acceleration accelerations accelerometer",
    "angular velocity": "gyro gyroscope omega",
    "velocity": "vel velocity velocities speed linear angular twist",
}
OF_WORDS = {word: quantity for quantity, words in SAID.items() for word in words.split()}
"""Quantities by the words of a name that say them; the last one counts, as in ``force_torque/torque/x``."""
ANGULAR = {"velocity": "angular velocity", "acceleration": "angular acceleration"}
TURNING = frozenset(("angular", "ang", "rot"))
COMPONENT = re.compile(r"([a-z]?)([wxyz])")
ALONE = {"height": "z"}
"""Words that are a component."""
Group = tuple[tuple[str, ...], str]
"""What names share that differ in their component alone, and the letter before this."""


@dataclass(frozen=True)
class VectorChoice:
    """Channels for a sensor of several numbers."""

    target: Target
    sources: tuple[str, ...]
    unit: str | None
    """Unit that their names state."""
    guess: str
    """Why it may be wrong; empty where names agree."""


def vector_choices(
    targets: Iterable[Target], signals: Sequence[Signal], room: float, unclear: dict[Target, str], *, least: int = 2
) -> list[VectorChoice]:
    """Return channels for sensors of several numbers, by the body in their names, or the only ones.

    Args:
        targets: Sensors of several numbers without channels.
        signals: Measured channels that are not taken.
        room: Largest position that is taken for metres; what lies beyond is guessed to be in millimetres.
        unclear: Why no channels were taken where several fit equally well; added to.
        least: Fewest components of a vector; those of a quaternion are four, so that x, y and z of one are no position.
    """
    wanted = [one for one in targets if one.size in AXES and one.quantity != "any"]
    groups = {one.name: _groups(signals, one, least if one.size == 3 else 4) for one in wanted}
    claims: dict[Target, tuple[Group, int]] = {}
    for target in wanted:
        own = groups[target.name]
        named = {group: count for group in own if (count := _shared(target, group)) > 0}
        shortest = min((len(stem) for stem, _ in named), default=0)  # other words may make it another thing
        near = [group for group in named if len(group[0]) == shortest] or list(own)
        alone = least > 1 and sum(one.quantity == target.quantity for one in wanted) == 1
        if len(near) > 1 and (named or alone):
            unclear[target] = equally([next(iter(own[group].values())) for group in near])
        elif len(near) == 1:
            claims[target] = near[0], named.get(near[0], 0)
    found: list[VectorChoice] = []
    for target, (group, count) in claims.items():
        names = {*groups[target.name][group].values()}
        others = {o: c for o, (g, c) in claims.items() if o != target and names & {*groups[o.name][g].values()}}
        if any(c > count for c in others.values()):
            continue
        if equal := [other for other, c in others.items() if c == count]:
            entries = " and ".join(entry_of(one) for one in (target, equal[0]))
            unclear[target] = f"{sorted(names)[0]} fits {entries} equally well"
            continue
        found.append(_choice(target, groups[target.name][group], signals, room, named=count > 0))
    return found


def _choice(
    target: Target, names: Mapping[str, str], signals: Sequence[Signal], room: float, *, named: bool
) -> VectorChoice:
    """Return the channels of a sensor, and why they may be others."""
    sources = tuple(names.get(axis, "") for axis in AXES[target.size])
    first = next(filter(None, sources))
    unit, guesses = named_unit(first, target.quantity), [] if named else ["the only ones"]
    if "" in sources:
        guesses.append("not all components are in the log")
    values = np.concatenate([one.value for one in signals if one.name in sources])
    far = float(np.nanmax(np.abs(values), initial=0.0))
    if unit is None and target.quantity == "length" and far > room:
        unit = "mm"
        guesses.append(f"values up to {far:.4g}")
    return VectorChoice(target, sources, unit, ", ".join(guesses))


def _shared(target: Target, group: Group) -> int:
    """Return how many words of its body or its own name a sensor shares with channels that have all of them."""
    said = {*words_of(target.name)}
    parts = [{*words_of(target.joint)}, said, {word for word in said if word not in OF_WORDS}]
    return max((len(words) for words in parts if words <= {*group[0]}), default=0)


def _groups(signals: Sequence[Signal], target: Target, least: int) -> dict[Group, Mapping[str, str]]:
    """Return the names of channels that differ in their components alone, by component, that a sensor may be of."""
    parts = {one.name: part for one in signals if (part := _part(one.name)) is not None}
    forces = {stem for (stem, letter), _ in parts.values() if letter == "f"}
    found: dict[Group, dict[str, str]] = {}
    for name, (group, axis) in parts.items():
        unit = parted_unit(name)[1]
        if unit and UNITS.get(unit, ("",))[0] != target.quantity and (unit, target.quantity) not in RATES:
            continue
        if target.quantity in _quantities(group, beside_force=group[0] in forces, unit=unit):
            found.setdefault(group, {})[axis] = name
    axes = {*AXES[target.size]}
    return {group: names for group, names in found.items() if {*names} <= axes and len(names) >= least}


def _part(name: str) -> tuple[Group, str] | None:
    """Return what a name shares with those of the other components, and its component; None if it is none."""
    words = parted_unit(name)[0]
    if not words or parsed(name).quantity == "other":
        return None
    if words[-1] in ALONE:
        return (tuple(words[:-1]), ""), ALONE[words[-1]]
    if hit := COMPONENT.fullmatch(words[-1]):
        return (tuple(words[:-1]), hit[1]), hit[2]
    axes = [k for k, word in enumerate(words) if word in ("x", "y", "z")]
    if len(axes) == 1 and any(word in OF_WORDS for word in words):
        k = axes[0]
        return (tuple(words[:k] + words[k + 1 :]), ""), words[k]
    return None


def _quantities(group: Group, *, beside_force: bool, unit: str) -> tuple[str, ...]:
    """Return what a vector may be, by the last word that says it, else by the letter before its components."""
    stem, letter = group
    said = next((OF_WORDS[word] for word in reversed(stem) if word in OF_WORDS), "")
    if said and TURNING & {*stem}:
        said = ANGULAR.get(said, said)
    known = LETTERS.get(letter, ())
    if letter in ("t", "m") and not said:
        known = ("torque",) if beside_force else known if letter == "t" or unit in ("Nm", "mNm") else ()
    return known if not said else (said,) if not letter or said in known else ()
