"""Channels for actuators and for sensors of one number, for a first map: by names, and by order where counts agree."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field

from concent_warp.recording.logs.channel_names import BY_FILLERS, LEVELS, OF_UNITS, agreement, parsed
from concent_warp.recording.logs.left_over import entry_of
from concent_warp.recording.logs.readers.log import Signal
from concent_warp.recording.logs.targets import Target
from concent_warp.recording.logs.units import contrary_unit, is_weak, parted_unit

UNCALLED = "no name says command"
"""Why channels that are taken for commands may be measured."""
PART = re.compile(r"[a-z]?[wxyz]")
"""Ends the name of a part of a vector or quaternion."""
May = Callable[[Target, Signal, int], bool]
"""Whether a channel may be that of an actuator or sensor with whose name it agrees to a level."""
ORDERED = ("position", "velocity")
"""Quantities of sensors whose channels are taken by order."""


@dataclass(frozen=True)
class Choice:
    """A channel for an actuator or sensor."""

    target: Target
    signal: Signal
    guess: str = ""
    """Why it may be wrong; empty where the names agree."""


@dataclass
class Matches:
    """What was found so far."""

    choices: list[Choice] = field(default_factory=list)
    unclear: dict[Target, str] = field(default_factory=dict)
    """Why no channel was taken for actuators and sensors for which several fit equally well."""
    kept: set[str] = field(default_factory=set)
    """Names of channels that are taken, or that fit several things equally well."""

    def add(self, choices: Iterable[Choice]) -> None:
        """Add choices."""
        for one in choices:
            self.choices.append(one)
            self.kept.add(one.signal.name)

    def left(self, targets: Iterable[Target]) -> list[Target]:
        """Return those for which there is neither a channel nor several that fit equally well."""
        done = {one.target for one in self.choices}
        return [one for one in targets if one not in done and one not in self.unclear]

    def free(self, signals: Iterable[Signal]) -> list[Signal]:
        """Return the channels that are not taken."""
        return [one for one in signals if one.name not in self.kept]


def is_command(one: Signal) -> bool:
    """Return whether the log, or the name of a channel, says that it is commanded."""
    return one.command or parsed(one.name).role == "command"


def kind_of(target: Target) -> str:
    """Return what names call the quantity of an actuator or sensor, empty where it is unknown."""
    return "position" if target.position else OF_UNITS.get(target.quantity, "")


def match_names(
    found: Matches, actuators: Sequence[Target], sensors: Sequence[Target], signals: Sequence[Signal]
) -> None:
    """Add the channels whose names agree: commands first, then measured ones, among them torques for motors.

    Args:
        found: What was found so far; added to.
        actuators: The actuators.
        sensors: The sensors of one number.
        signals: The channels.
    """
    commands = [one for one in signals if is_command(one)]
    readings = [one for one in signals if not is_command(one)]
    _add_named(found, actuators, commands, _may_set)
    motors = [one for one in found.left(actuators) if kind_of(one) in ("", "effort")]
    _add_named(found, [*sensors, *motors], readings, _may_read)


def match_order(
    found: Matches, actuators: Sequence[Target], sensors: Sequence[Target], signals: Sequence[Signal]
) -> None:
    """Add commands, positions and velocities by their order, where as many are left as there are things without one."""
    commands = [one for one in found.free(signals) if is_command(one)]
    left = found.left(actuators)
    fitting = [one for one in commands if any(_may_set_by_order(target, one, 0) for target in left)]
    if len(fitting) != len(left):
        fitting = [one for one in fitting if parsed(one.name).quantity in ("", "position")]
    _by_order(found, left, fitting, _may_set_by_order, actuators)
    names = {one.name for one in signals}
    for kind in ORDERED:
        left = [one for one in found.left(sensors) if kind_of(one) == kind and (one.position or one.velocity)]
        free = [one for one in found.free(signals) if not is_command(one) and said_or_position(one.name) == kind]
        free = [one for one in free if not one.name.endswith(("/x", "/y", "/z", "/w"))]
        free = [one for one in free if not _in_vector(one.name, names) and not _is_part(one.name)]
        _by_order(found, left, free, _may_read, sensors)


def _in_vector(name: str, names: Collection[str]) -> bool:
    """Return whether a channel is one of three such as fx, fy and fz."""
    hit = re.fullmatch(r"(|.*[^A-Za-z])([A-Za-z])([xyzXYZ])(|[^A-Za-z].*)", name)
    if hit is None:
        return False
    axes = "xyz" if hit[3].islower() else "XYZ"
    return all(f"{hit[1]}{hit[2]}{axis}{hit[4]}" in names for axis in axes)


def _is_part(name: str) -> bool:
    """Return whether a channel is named after a part of a vector or quaternion, such as fx, whatever else there is."""
    last = parted_unit(name)[0][-1:]
    return bool(last) and len(last[0]) > 1 and PART.fullmatch(last[0]) is not None


def match_left(
    found: Matches, actuators: Sequence[Target], sensors: Sequence[Target], signals: Sequence[Signal]
) -> None:
    """Add channels that nothing else is mapped to by order for as many actuators, where all may be their commands.

    Those that state the quantity of the actuators count before those that state none. None is taken where a sensor
    without a channel may be what they are of.
    """
    left, free = found.left(actuators), found.free(signals)
    may = [one for one in free if left and all(_may_command(target, one) for target in left)]
    done = [one for one in (*actuators, *sensors) if one.joint not in {target.joint for target in left}]
    may = [one for one in may if not any(_of_another(target, one, done) for target in left)]
    stated = [one for one in may if any(parsed(one.name).quantity == (kind_of(t) or "effort") for t in left)]
    chosen = next((some for some in (stated, may) if len(some) == len(left)), [])
    pairs = list(zip(left, chosen, strict=False))
    unread = {kind_of(one) for one in sensors if one not in {choice.target for choice in found.choices}}
    unread_or_named = any(said_or_position(one.name) in unread for one in chosen) or any(
        _of_another(*pair, actuators) for pair in pairs
    )
    if not unread_or_named and not any(map(is_command, may)):
        found.add(Choice(*pair, f"by order, {UNCALLED}") for pair in pairs)


def said_or_position(name: str) -> str:
    """Return the quantity that a name says, position if it says none."""
    return parsed(name).quantity or "position"


def _add_named(found: Matches, targets: Sequence[Target], signals: Sequence[Signal], may: May) -> None:
    """Add the channels whose names agree best with those of targets, and what fits several equally well."""
    levels: dict[int, list[tuple[Target, Signal]]] = {}
    for target in found.left(targets):
        for one in found.free(signals):
            level = agreement(one.name, target.name, target.joint)
            if level is not None and may(target, one, level):
                levels.setdefault(level, []).append((target, one))
    for level in range(LEVELS):
        pairs = levels.get(level, [])
        left, free = found.left(targets), {one.name for one in found.free(signals)}
        pairs = [(target, one) for target, one in pairs if target in left and one.name in free]
        if level >= BY_FILLERS:
            pairs = _of_same_numbers(pairs, left, [one for one in signals if one.name in free])
        _settle(found, pairs)


def _settle(found: Matches, pairs: Sequence[tuple[Target, Signal]]) -> None:
    """Add the pairs that share nothing with another, and say of the others that they are equally good."""
    for target in dict.fromkeys(target for target, _ in pairs):
        names = [one.name for other, one in pairs if other == target]
        rivals = [other for other, one in pairs if one.name in names and other != target]
        if len(names) > 1:
            found.unclear[target] = equally(names)
        elif rivals:
            entries = [entry_of(one) for one in (target, *dict.fromkeys(rivals))]
            found.unclear[target] = f"{names[0]} fits {_listed(entries)} equally well"
        else:
            (hit,) = (one for other, one in pairs if other == target)
            found.add([Choice(target, hit, UNCALLED if target.command and not is_command(hit) else "")])
    found.kept |= {one.name for _, one in pairs}


def equally(names: Sequence[str]) -> str:
    """Return that channels fit equally well."""
    return f"{_listed(names)} fit equally well"


def _listed(names: Sequence[str]) -> str:
    """Return two of some names, and the number of others."""
    more = f" and {len(names) - 2} more" if len(names) > 2 else ""
    return f"{names[0]}, {names[1]}{more}" if more else f"{names[0]} and {names[1]}"


def _of_same_numbers(
    pairs: Sequence[tuple[Target, Signal]], targets: Sequence[Target], signals: Sequence[Signal]
) -> list[tuple[Target, Signal]]:
    """Return pairs without those whose names agree in a number alone, where others are counted from another one.

    ``q0`` to ``q5`` may be those of ``joint1`` to ``joint6``.
    """

    def number(name: str) -> str:
        core = parsed(name).forms[2]
        return core[0] if len(core) == 1 and core[0].isdecimal() else ""

    def numbers(names: Iterable[str]) -> set[int]:
        return {int(number(name)) for name in names} if names else set()

    kept: list[tuple[Target, Signal]] = []
    for target, one in pairs:
        if not number(one.name):
            kept.append((target, one))
            continue
        alike = [s.name for s in signals if number(s.name) and _alike(s.name, one.name)]
        others = [t.name if number(t.name) else t.joint for t in targets if kind_of(t) == kind_of(target)]
        if numbers(alike) == numbers([name for name in others if number(name)]):
            kept.append((target, one))
    return kept


def _alike(name: str, other: str) -> bool:
    """Return whether two names differ in their number alone."""
    return re.sub(r"\d+", "", name) == re.sub(r"\d+", "", other)


def _by_order(
    found: Matches, left: Sequence[Target], free: Sequence[Signal], may: May, targets: Sequence[Target]
) -> None:
    """Add channels for as many targets by their order, where each may be that of its own."""
    pairs = list(zip(left, free, strict=False))
    if len(left) == len(free) and all(may(*pair, 0) and not _of_another(*pair, targets) for pair in pairs):
        found.add(Choice(*pair, "by order") for pair in pairs)


def _of_another(target: Target, one: Signal, targets: Sequence[Target]) -> bool:
    """Return whether a channel is named after another joint than a target is of."""

    def named(other: Target) -> bool:
        level = agreement(one.name, other.name, other.joint)
        return level is not None and level < BY_FILLERS

    return any(other.joint != target.joint and named(other) for other in targets) and not named(target)


def _may_set(actuator: Target, one: Signal, _level: int) -> bool:
    """Return whether a command may be an actuator's: its name says no other quantity."""
    kind = kind_of(actuator)
    return not kind or parsed(one.name).quantity in ("", kind)


def _may_set_by_order(actuator: Target, one: Signal, level: int) -> bool:
    """Return whether a command may be an actuator's, also where a unit in its name says otherwise, which is said."""
    return _may_set(actuator, one, level) or _says_by_unit(one.name)


def _says_by_unit(name: str) -> bool:
    """Return whether the unit at the end of a name alone says a quantity, and no word."""
    unit = parted_unit(name)[1]
    return bool(unit) and parsed("_".join(parted_unit(name)[0])).quantity == ""


def _may_read(target: Target, one: Signal, level: int) -> bool:
    """Return whether a measured channel may be that of a sensor, or a torque that of a motor."""
    name, kind = parsed(one.name), kind_of(target)
    if level == 0 and is_weak(one.name) and is_weak(target.name):
        return True  # both end alike in what may be no unit
    if target.command:
        return name.quantity == "effort" and name.role != "measured"
    if name.quantity == kind:
        return True
    return not name.quantity and (kind == "position" or level < 2)


def _may_command(actuator: Target, one: Signal) -> bool:
    """Return whether a channel may be an actuator's command: no part of a vector, nor said to be another quantity."""
    name, last = parsed(one.name), parted_unit(one.name)[0][-1:]
    return (
        name.quantity in ("", kind_of(actuator) or name.quantity)
        and name.role != "measured"
        and contrary_unit(one.name, actuator.quantity) is None
        and not (last and PART.fullmatch(last[0]))
    )
