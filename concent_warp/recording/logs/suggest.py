"""A first map from a log to a scene, by names and, where numbers of channels are equal, by order."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.recording.logs.import_log import Source, scene_of
from concent_warp.recording.logs.readers.kinds import log_kind, log_sources
from concent_warp.recording.logs.readers.log import Episode, Images, Signal
from concent_warp.recording.logs.readers.open_log import open_log
from concent_warp.recording.logs.scene_gaps import measured_gaps, nameless_actuators, unread_joints
from concent_warp.recording.logs.suggest_vectors import VectorChoice, vector_choices
from concent_warp.recording.logs.targets import Target, body_sensors, named_parts, targets_of
from concent_warp.recording.logs.units import (
    SHARES,
    SI,
    UNIT_WORDS,
    UNITS,
    contrary_unit,
    parted_unit,
    stated_unit,
    words_of,
)
from concent_warp.scene.scene import Scene

WORDS = {
    "position": ("pos", "position", "positions", "qpos", "angle", "state", "enc", "encoder"),
    "velocity": ("vel", "velocity", "velocities", "qvel", "speed"),
    "effort": ("effort", "torque", "current", "load", "force"),
    "acceleration": ("acc", "accel", "acceleration", "accelerations"),
}
"""Words that name a quantity and not a joint."""
OF_QUANTITIES = {
    "angle": "position", "length": "position", "angular velocity": "velocity", "velocity": "velocity",
    "torque": "effort", "force": "effort", "acceleration": "acceleration", "angular acceleration": "acceleration",
}  # fmt: skip
"""What names call a quantity, as in `WORDS`, by that of a unit or an actuator."""
FILLERS = ("observation", "action", "joint", "joints", "states", "command", "commands", "cmd", "goal", "data", "motor",
           "main", "follower", "leader", "actuator", "sensor", "measured", "servo", "target", "setpoint", "desired",
           "actual")  # fmt: skip
"""Words that do not tell one joint from another."""
ROOM = 20.0
"""Distance of a body from the origin above which positions are guessed to be in millimetres [m]."""
MAX_DEGREES = 720.0
"""Largest value that is guessed to be an angle in degrees [deg]."""


GAP = "# scene: "
"""Begins a line of a map that says what the scene lacks."""
UNCALLED = "no name says command"
"""Why channels that are taken for commands may be measured."""
PART = re.compile(r"[a-z]?[wxyz]")
"""Ends the name of a part of a vector or quaternion."""


@dataclass(frozen=True)
class _Choice:
    """A channel for an actuator or sensor."""

    target: Target
    signal: Signal
    guess: str = ""
    """Why it may be wrong; empty where the names agree."""


def suggest_map(source: Source, model: Path | str | Scene, episode: int | None = None) -> str:
    """Return a map for a log and a scene as TOML, to be read and corrected by its user; guesses are marked.

    Args:
        source: See `import_log`; of several logs the first is looked at.
        model: See `import_log`.
        episode: Episode that is looked at; the first by default.

    Raises:
        RecordingError: The log cannot be read.
        SceneError: The scene cannot be read.
    """
    scene = scene_of(model)
    m = scene.model
    parts = named_parts(m)
    first = log_sources(source, parts)[0]
    if first.exists() and log_kind(first) == "bop":
        raise RecordingError("a scene of a BOP data set needs no map", where=first, fix="import it with -o demo.h5")
    log = open_log(first, parts)
    found = log.episode(log.numbers[0] if episode is None else episode)
    actuators, sensors = targets_of(m)
    commands = [one for one in found.signals.values() if one.command]
    readings = [one for one in found.signals.values() if not one.command]
    lines = [f"# Map from {first.name} ({log.kind}): check every line, above all units and signs.", ""]
    efforts = [one for one in readings if _quantity(one.name) == "effort"]
    if not commands and len(efforts) == len(actuators) and not any(one.position for one in actuators.values()):
        readings = [one for one in readings if one not in efforts]
        called = _matched(list(actuators.values()), efforts)
        chosen = [replace(one, guess=", ".join(filter(None, (one.guess, UNCALLED)))) for one in called]
    else:
        chosen = _matched(list(actuators.values()), commands)
    joints = [one for one in sensors.values() if one.size == 1]
    measured = _matched([one for one in joints if one.position], _of(readings, "position"))
    measured += _matched([one for one in joints if one.velocity], _of(readings, "velocity"))
    bodies = [m.body(i).name for i in range(1, m.nbody) if all(body_sensors(m, m.body(i).name))]
    poses = sorted({n.removesuffix("/orientation/w") for n in found.signals if n.endswith("/orientation/w")})
    poses = [one for one in poses if f"{one}/position/x" in found.signals]
    under = tuple(f"{pose}/" for pose in poses)
    used = {one.signal.name for one in (*chosen, *measured)} | {n for n in found.signals if n.startswith(under)}
    several, vectors = [], []
    if not poses:
        several = [one for one in sensors.values() if one.size > 1]
        loose = [one for one in readings if one.name not in used and _quantity(one.name) == "position"]
        vectors = vector_choices(several, loose, ROOM)
        used |= {name for one in vectors for name in one.sources}
    named = {one.target.name for one in (*chosen, *measured)}
    unread = any(one.position and one.name not in named for one in joints)
    free = [one for one in found.signals.values() if one.name not in used]
    more = _left_for([one for one in actuators.values() if one.name not in named], free, unread=unread)
    chosen, used = chosen + more, used | {one.signal.name for one in more}
    lines += _section("action", list(actuators.values()), chosen)
    lines += _section("measured", [one for one in joints if one.position], measured)
    lines += _bodies(bodies, poses)
    lines += _vectors(several, vectors)
    lines += _images(found)
    if any(one.frames for one in found.signals.values()):
        lines += ["# [clock]  # the table has numbers of frames, and no times", '# "*" = { rate = ? }  # in Hz', ""]
    left = [name for name in found.signals if name not in used]
    gaps = [one for one in (nameless_actuators(m), *measured_gaps(scene, _sought(scene, found, left))) if one]
    lines[1:1] = [f"{GAP}{one}" for one in gaps]
    if left:
        lines += ["# Channels of the log that are not mapped:", *(f"#   {name}" for name in left)]
    return "\n".join(lines).rstrip() + "\n"


def _sought(scene: Scene, episode: Episode, left: Sequence[str]) -> list[str]:
    """Return the joints without a sensor whose position channels that are not mapped may be, by their names."""
    free = [{*words_of(n)} for n in left if not episode.signals[n].command and _quantity(n) == "position"]
    joints = [(joint, {*_key(joint).split("_")} - {""}) for joint in unread_joints(scene)]
    return [joint for joint, words in joints if words and any(words <= name for name in free)]


def _of(signals: Sequence[Signal], quantity: str) -> list[Signal]:
    """Return the channels of a quantity; those whose name says none count as positions."""
    found = []
    for one in signals:
        if _quantity(one.name) == quantity and not one.name.endswith(("/x", "/y", "/z", "/w")):
            found.append(one)
    return found


def _quantity(name: str) -> str:
    """Return the quantity that a name says, position if it says none."""
    return _said_quantity(name) or "position"


def _said_quantity(name: str) -> str:
    """Return the quantity that a name says by a word or the unit at its end, empty if it says none."""
    words = [word.rstrip("0123456789") for word in words_of(name)]
    said = [q for q, known in WORDS.items() if any(word in known for word in words if word != "state")]
    unit = parted_unit(name)[1]
    return said[-1] if said else OF_QUANTITIES[UNITS[unit][0]] if unit in UNITS else ""


def _matched(targets: Sequence[Target], signals: Sequence[Signal]) -> list[_Choice]:
    """Return a channel for each target that has one: by name first, what is left by order if the counts are equal.

    A name that has the same words in another order is one where it is the only one for its target and no other's.
    """
    positions = _of(signals, "position") if len(signals) != len(targets) else list(signals)
    found: dict[str, _Choice] = {}
    free = list(positions or signals)
    for target in targets:
        keys = {_key(target.name), _key(target.joint)} - {""}
        hit = next((one for one in free if _keys(one.name) & keys), None)
        if hit is not None:
            free.remove(hit)
            found[target.name] = _Choice(target, hit)
    left = [target for target in targets if target.name not in found]
    alike = {target.name: [one for one in free if _same_words(target, one.name)] for target in left}
    for target in left:
        hits = alike[target.name]
        if len(hits) == 1 and sum(hits[0] in others for others in alike.values()) == 1:
            free.remove(hits[0])
            found[target.name] = _Choice(target, hits[0])
    left = [target for target in left if target.name not in found]
    if left and len(left) == len(free):
        pairs = zip(left, free, strict=True)
        found |= {target.name: _Choice(target, one, "by order") for target, one in pairs}
    return [found[target.name] for target in targets if target.name in found]


def _same_words(target: Target, name: str) -> bool:
    """Return whether a channel is named by the words of a target, or of its joint, in any order."""
    keys = [sorted(key.split("_")) for key in (_key(target.name), _key(target.joint)) if key]
    return any(sorted(key.split("_")) in keys for key in _keys(name))


def _left_for(actuators: Sequence[Target], left: Sequence[Signal], *, unread: bool) -> list[_Choice]:
    """Return channels that nothing else is mapped to, by order for as many actuators, where all may be commands.

    Args:
        actuators: Those without a channel.
        left: The channels.
        unread: Whether sensors of positions have no channel, so that one of unknown quantity may be theirs.
    """
    if len(actuators) != len(left) or not all(map(_may_command, actuators, left)):
        return []
    if unread and any(_quantity(one.name) == "position" for one in left):
        return []
    return [_Choice(*pair, f"by order, {UNCALLED}") for pair in zip(actuators, left, strict=True)]


def _may_command(actuator: Target, one: Signal) -> bool:
    """Return whether a channel may be an actuator's command: no part of a vector, nor said to be another quantity."""
    said = _said_quantity(one.name)
    last = parted_unit(one.name)[0][-1:]
    return (
        said in ("", OF_QUANTITIES.get(actuator.quantity, said))
        and contrary_unit(one.name, actuator.quantity) is None
        and not (last and PART.fullmatch(last[0]))
    )


def _section(kind: str, targets: Sequence[Target], choices: Sequence[_Choice]) -> list[str]:
    """Return the lines of commands or measurements."""
    lines = []
    for choice in choices:
        unit, why = _unit(choice)
        guess = ", ".join(filter(None, (choice.guess, why)))
        lines += [f"[{kind}.{_quoted(choice.target.name)}]" + (f"  # guess: {guess}" if guess else "")]
        lines += [f"source = {_text(choice.signal.name)}"]
        lines += [f"unit = {_text(unit)}"] if unit else []
        lines += [""]
    matched = {choice.target.name for choice in choices}
    for target in targets:
        if target.name not in matched:
            what = "source = ?" + (", or constant = ?" if kind == "action" else "")
            lines += [f"# [{kind}.{_quoted(target.name)}]  # no channel found", f"# {what}", ""]
    return lines


def _vectors(targets: Sequence[Target], choices: Sequence[VectorChoice]) -> list[str]:
    """Return the lines of sensors of several numbers."""
    lines = []
    for one in choices:
        lines += [f"[measured.{_quoted(one.target.name)}]" + (f"  # guess: {one.guess}" if one.guess else "")]
        lines += [f"source = [{', '.join(_text(name) for name in one.sources)}]"]
        lines += [f"unit = {_text(one.unit)}"] if one.unit else []
        lines += ['order = "xyzw"'] if one.target.quantity == "orientation" else []
        lines += [""]
    for target in targets:
        if target not in [one.target for one in choices]:
            lines += [f"# [measured.{_quoted(target.name)}]  # no channel found", "# source = [?]", ""]
    return lines


def _unit(choice: _Choice) -> tuple[str, str]:
    """Return the unit that the name states, else the one that the values suggest, and why; empty where SI fits."""
    name, target = choice.signal.name, choice.target
    value = choice.signal.value[np.isfinite(choice.signal.value)]
    unit = stated_unit(name, target.quantity) or ""
    if unit in SHARES:
        why = "" if target.range else "the scene has no range"
        return ("signed_percent" if unit == "percent" and value.size and value.min() < 0 else unit), why
    if unit and unit not in SI.values():
        return unit, ""
    guess, why = _guessed_unit(value, target)
    if other := contrary_unit(name, target.quantity):
        return guess, f"its name states {other}, which is no unit of {target.quantity}"
    return guess or ("" if why else unit), why


def _guessed_unit(value: np.ndarray, target: Target) -> tuple[str, str]:
    """Return the unit that values (n,) suggest, and why; empty where SI fits."""
    if not value.size or not target.position:
        return "", ""
    low, high = float(value.min()), float(value.max())
    size, span = max(abs(low), abs(high)), target.range
    if target.quantity == "angle":
        inside = span is None or (low >= span[0] - 0.35 and high <= span[1] + 0.35)
        if inside and size <= 4 * math.pi:
            return "", ""
        factor = math.pi / 180
        if size <= MAX_DEGREES and (
            span is None or (low * factor >= span[0] - 0.35 and high * factor <= span[1] + 0.35)
        ):
            percent = ", may be a percentage" if low >= -100 and high <= 100 else ""
            return "deg", f"values from {low:.4g} to {high:.4g}{percent}"
    elif target.quantity == "length" and span is not None:
        if size <= 1.5 * max(abs(span[0]), abs(span[1])):
            return "", ""
        if 1e-3 * size <= 1.5 * max(abs(span[0]), abs(span[1])) and not 0 <= low <= high <= 100:
            return "mm", f"values from {low:.4g} to {high:.4g}"
    elif target.quantity == "length":
        return ("mm", f"values from {low:.4g} to {high:.4g}") if size > ROOM else ("", "")
    if span is not None and low >= -100 and high <= 100:
        return ("percent" if low >= 0 else "signed_percent"), f"values from {low:.4g} to {high:.4g}"
    return "", f"values from {low:.4g} to {high:.4g} fit no unit"


def _bodies(bodies: Sequence[str], poses: Sequence[str]) -> list[str]:
    """Return the lines of tracked bodies."""
    lines, free = [], list(poses)
    for body in bodies:
        hit = next((one for one in free if _key(body) and _key(body) in _key(one)), None)
        guess = ""
        if hit is None and len(bodies) == len(poses) == 1:
            hit, guess = free[0], "  # guess: the only pose"
        if hit is not None:
            free.remove(hit)
            lines += [f"[body.{_quoted(body)}]{guess}", f"source = {_text(hit)}", ""]
    return lines


def _images(episode: Episode) -> list[str]:
    """Return the lines of cameras: each colour stream with the depths of its size whose name is most alike."""
    lines = []
    depths = [one for one in episode.images.values() if one.depth]
    for color in (one for one in episode.images.values() if not one.depth):
        fitting = [one for one in depths if one.size == color.size] or depths
        depth = max(fitting, key=lambda one: _alike(one, color), default=None)
        lines += [f"[image.{_quoted(_camera_name(color.name))}]", f"color = {_text(color.name)}"]
        if depth is not None:
            remark = "" if depth.size == color.size else "  # of another size: not registered to colour"
            lines += [f"depth = {_text(depth.name)}{remark}"]
        if color.frame:
            lines += [f"# frame = {_text(color.frame)}", '# reference = "world"  # frame of the scene\'s world']
        lines += [""]
    return lines


def _alike(one: Images, other: Images) -> int:
    """Return how many words two names share."""
    return len(set(words_of(one.name)) & set(words_of(other.name)))


def _camera_name(name: str) -> str:
    """Return a short name of a camera."""
    generic = ("color", "colour", "rgb", "image", "images", "raw", "rect", "compressed", "observation")
    words = [word for word in words_of(name) if word not in generic]
    return "_".join(words) or "camera"


def _keys(name: str) -> set[str]:
    """Return what may tell a channel's joint from another: all of its name, and what is behind topics or dots."""
    before, unit = parted_unit(name)
    parts = {_key(one) for one in (name, name.rpartition("/")[2], re.split(r"[/.]", name)[-1])}
    return parts | ({_key("_".join(before))} if unit else set())


def _key(name: str) -> str:
    """Return what tells one joint from another in a name."""
    quantities = {word for words in WORDS.values() for word in words}
    quantities |= {*FILLERS, *UNIT_WORDS}
    kept = [word for word in words_of(name) if word not in quantities]
    return "_".join(kept)


def _text(value: str) -> str:
    """Return a text as TOML."""
    import json

    return json.dumps(value, ensure_ascii=False)


def _quoted(name: str) -> str:
    """Return a key of TOML."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _text(name)
