"""What the name of a channel says by convention: its quantity, whether it is commanded or measured, and of which joint.

Words are parted by ``_ . / -``, spaces and camelCase, and may be in any order: ``q_hip``, ``hip.pos`` and ``hipAngle``.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache

from concent_warp.recording.logs.units import (
    ENDINGS,
    MOST_WORDS,
    RATES,
    UNIT_WORDS,
    UNITS,
    is_weak,
    parted_unit,
    words_of,
)

QUANTITIES = {
    "position": "q qpos pos position positions angle angles theta jointpos actuatorpos tendonpos",
    "velocity": "dq qd qdot qvel vel velocity velocities speed omega thetadot dtheta posdot jointvel actuatorvel",
    "effort": "tau torque torques effort efforts force forces",
    "acceleration": "acc accel acceleration accelerations ddq qdd qacc",
    "other": "voltage temperature temp error err pwm duty",
}
"""Words that say a quantity."""
OF_WORDS = {word: quantity for quantity, words in QUANTITIES.items() for word in words.split()}
OF_UNITS = {
    "angle": "position", "length": "position", "angular velocity": "velocity", "velocity": "velocity",
    "torque": "effort", "force": "effort", "acceleration": "acceleration", "angular acceleration": "acceleration",
}  # fmt: skip
"""What names call a quantity, as in `QUANTITIES`, by that of a unit, an actuator or a sensor."""
COMMANDED = frozenset(
    word
    for words in (
        "cmd cmds command commands commanded ctrl action actions goal goals",
        "target targets des desired ref reference setpoint setpoints",
    )
    for word in words.split()
)
"""Words that say that a channel is commanded; ``u`` does beside other words."""
MEASURED = frozenset(
    word
    for words in (
        "meas measured measurement act actual state fb feedback",
        "enc encoder encoders sensor sensed present",
    )
    for word in words.split()
)
"""Words that say that a channel is measured."""
FILLERS = frozenset(
    word
    for words in ("observation joint joints states data", "motor main follower leader actuator servo")
    for word in words.split()
)
"""Words that do not tell one joint from another."""
PAIRS = {
    ("set", "point"): "setpoint", ("q", "dot"): "qdot", ("theta", "dot"): "thetadot", ("pos", "dot"): "posdot",
    ("angle", "dot"): "thetadot", ("position", "dot"): "posdot",
}  # fmt: skip
"""Words that are one."""
LEVELS = 6
"""Kinds of agreement of `agreement`, from the best."""
BY_FILLERS = 4
"""Agreement from which words are left out that may tell one joint from another."""
Words = tuple[str, ...]


@dataclass(frozen=True)
class Name:
    """What the name of a channel, or of a thing of the scene, says."""

    words: tuple[str, ...]
    """All words without the unit."""
    quantity: str
    """One of `QUANTITIES`, empty where it says none; other also where it says two."""
    role: str
    """``command``, ``measured`` or empty."""
    forms: tuple[tuple[str, ...], ...]
    """Words without those of its role, also without those of its quantity, and also without fillers."""


@lru_cache(maxsize=4096)
def parsed(name: str) -> Name:
    """Return what a name says."""
    words = tuple(_joined(parted_unit(name)[0]))
    quantity, decided = _quantity(name)
    said, rest = {*words}, [word for word in words if word != "u"]
    if COMMANDED & said or 0 < len(rest) < len(words):
        role = "command"
    else:
        role = "measured" if MEASURED & said or ("current" in said and quantity not in ("", "other")) else ""
    return Name(words, quantity, role, _forms(words, decided))


def _forms(words: tuple[str, ...], decided: str = "") -> tuple[tuple[str, ...], ...]:
    """Return what is left of words without those of a role, of a quantity, and fillers; see `Name.forms`."""
    roles = COMMANDED | MEASURED | ({"u"} if len(words) > 1 else set())
    roleless = tuple(word for word in words if word not in roles)
    plain = tuple(word for word in roleless if word not in OF_WORDS and word not in ("current", decided))
    core = tuple(word for word in plain if word not in FILLERS and word not in UNIT_WORDS)
    return roleless, plain, core


def _quantity(name: str) -> tuple[str, str]:
    """Return the quantity that a name says, and the word that says it where this may also name a thing.

    A word of the last part of a topic counts before those of the others, and words before the unit at the end.
    """
    for text in dict.fromkeys((name.rpartition("/")[2], name)):
        words = [*_joined(parted_unit(text)[0])]
        if said := {OF_WORDS[word] for word in words if word in OF_WORDS}:
            quantity = said.pop() if len(said) == 1 else "other"
            return ("other" if _contradicts(name, quantity) else quantity), ""
    words = [*_joined(parted_unit(name)[0])]
    if unit := parted_unit(name)[1] or _inner_unit(words):
        return (OF_UNITS[UNITS[unit][0]] if unit in UNITS else ""), ""
    if {"enc", "encoder", "encoders"} & {*words}:
        return "position", ""
    if "current" in words:
        return "other", ""
    return ("effort", "load") if "load" in words else ("", "")


def _contradicts(name: str, quantity: str) -> bool:
    """Return whether the unit at the end of a name is one of another quantity than its words say."""
    unit = parted_unit(name)[1]
    if unit not in UNITS or is_weak(name) or quantity == "other":
        return False
    rates = {OF_UNITS[rate] for (short, rate) in RATES if short == unit}
    return quantity not in (OF_UNITS[UNITS[unit][0]], *rates)


def _inner_unit(words: list[str]) -> str:
    """Return a unit that words within a name state, such as rpm of ``rpm_wheel``; empty without any."""
    for start in range(len(words)):
        for count in range(min(MOST_WORDS, len(words) - start), 0, -1):
            ending = tuple(words[start : start + count])
            if ending in ENDINGS and (count > 1 or ending[0] in UNIT_WORDS):
                return ENDINGS[ending]
    return ""


def _joined(words: list[str]) -> list[str]:
    """Return words with numbers parted from known ones, as in ``q1``, and with `PAIRS` as one."""
    known = {*OF_WORDS, *COMMANDED, *MEASURED, *FILLERS, "u"}
    parted: list[str] = []
    for word in words:
        hit = re.fullmatch(r"([a-z]+)(\d+)", word)
        parted += [hit[1], hit[2]] if hit and hit[1] in known else [word]
    found: list[str] = []
    for word in parted:
        if found and (found[-1], word) in PAIRS:
            found[-1] = PAIRS[found[-1], word]
        else:
            found.append(word)
    return found


def agreement(channel: str, name: str, joint: str) -> int | None:
    """Return how well the name of a channel agrees with that of an actuator or sensor, None if it does not.

    0 is that of the same words, 1 of these in another order; 2 and 3 of what is left without words of roles and
    quantities, here the joint counts, too; 4 and 5 of what is left without fillers.

    Args:
        channel: Name of the channel; what is before the last ``/`` or ``.`` may be left out.
        name: Name of the actuator or sensor.
        joint: Joint, tendon or body that it acts on or reads, empty without one.
    """
    words, things, cores = _wanted(name, joint)
    best = None
    for own, forms in _variants(channel):
        for k, (left, right) in enumerate((({own}, words), ({*forms[:2]}, things), ({forms[2]}, cores))):
            level = _same(left, right)
            if level is not None:
                best = 2 * k + level if best is None else min(best, 2 * k + level)
                break
    return best


@lru_cache(maxsize=4096)
def _wanted(name: str, joint: str) -> tuple[frozenset[Words], frozenset[Words], frozenset[Words]]:
    """Return the words of an actuator or sensor, these and its joint's without roles and quantities, and cores."""
    whole, driven = tuple(_joined(words_of(name))), tuple(_joined(words_of(joint)))
    weak, said = is_weak(name), parsed(name)
    forms = _forms(whole) if weak else said.forms
    words = frozenset((whole,) if weak else (whole, said.words))
    return words, frozenset((*forms[:2], driven)), frozenset((forms[2], _forms(driven)[2]))


@lru_cache(maxsize=4096)
def _variants(channel: str) -> tuple[tuple[Words, tuple[Words, ...]], ...]:
    """Return words and forms of a name, and of its ends; also with what may be a unit at the end or another word."""
    found: list[tuple[Words, tuple[Words, ...]]] = []
    for text in dict.fromkeys((channel, channel.rpartition("/")[2], re.split(r"[/.]", channel)[-1])):
        one, full = parsed(text), tuple(_joined(words_of(text)))
        found += [(one.words, one.forms), (full, _forms(full) if is_weak(text) else one.forms)]
    return tuple(found)


def _same(left: Collection[Words], right: Collection[Words]) -> int | None:
    """Return 0 if two sets have words in common, 1 if these are in another order, None if they have not."""
    if any(one and one in right for one in left):
        return 0
    ordered = [sorted(one) for one in right]
    return 1 if any(one and sorted(one) in ordered for one in left) else None
