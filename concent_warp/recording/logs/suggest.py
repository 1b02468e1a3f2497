"""A first map from a log to a scene, by names and, where numbers of channels are equal, by order."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.recording.logs.channel_names import parsed
from concent_warp.recording.logs.import_log import Source, scene_of
from concent_warp.recording.logs.readers.kinds import log_kind, log_sources
from concent_warp.recording.logs.readers.log import Episode, Images, Signal
from concent_warp.recording.logs.readers.open_log import open_log
from concent_warp.recording.logs.scene_gaps import scene_gaps, unread_joints
from concent_warp.recording.logs.suggest_matches import (
    Choice,
    Matches,
    is_command,
    match_left,
    match_names,
    match_order,
    said_or_position,
)
from concent_warp.recording.logs.suggest_vectors import VectorChoice, vector_choices
from concent_warp.recording.logs.targets import Target, body_sensors, named_parts, targets_of
from concent_warp.recording.logs.units import (
    SHARES,
    SI,
    contrary_unit,
    stated_unit,
    words_of,
)
from concent_warp.scene.scene import Scene

ROOM = 20.0
"""Distance of a body from the origin above which positions are guessed to be in millimetres [m]."""
MAX_DEGREES = 720.0
"""Largest value that is guessed to be an angle in degrees [deg]."""


GAP = "# scene: "
"""Begins a line of a map that says what the scene lacks."""
NONE_FOUND = "no channel found"
"""Said of an actuator or sensor without a channel, with the reason where several fit equally well."""


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
    actuators, sensors = (list(one.values()) for one in targets_of(m))
    signals = list(found.signals.values())
    lines = [f"# Map from {first.name} ({log.kind}): check every line, above all units and signs.", ""]
    poses = sorted({n.removesuffix("/orientation/w") for n in found.signals if n.endswith("/orientation/w")})
    poses = [one for one in poses if f"{one}/position/x" in found.signals]
    bodies = [m.body(i).name for i in range(1, m.nbody) if all(body_sensors(m, m.body(i).name))]
    under = tuple(f"{pose}/" for pose in poses)
    several = [one for one in sensors if one.size > 1 and not (poses and one.quantity in ("length", "orientation"))]
    single = [one for one in sensors if one.size == 1]
    matches = Matches(kept={name for name in found.signals if name.startswith(under)} if under else set())
    match_names(matches, actuators, single, signals)
    vectors = _vector_choices(matches, several, signals, 2)
    match_order(matches, actuators, single, signals)
    vectors += _vector_choices(matches, [one for one in several if one not in [v.target for v in vectors]], signals, 1)
    match_left(matches, actuators, single, signals)
    lines += _section("action", actuators, matches)
    lines += _section("measured", single, matches)
    lines += _bodies(bodies, poses)
    lines += _vectors(several, vectors, matches)
    lines += _images(found)
    if any(one.frames for one in signals):
        lines += ["# [clock]  # the table has numbers of frames, and no times", '# "*" = { rate = ? }  # in Hz', ""]
    used = {one.signal.name for one in matches.choices} | {name for one in vectors for name in one.sources}
    left = [name for name in found.signals if name not in used and not (under and name.startswith(under))]
    gaps = scene_gaps(scene, _sought(scene, found, left))
    lines[1:1] = [f"{GAP}{one}" for one in gaps]
    if left:
        lines += ["# Channels of the log that are not mapped:", *(f"#   {name}" for name in left)]
    return "\n".join(lines).rstrip() + "\n"


def _vector_choices(
    matches: Matches, targets: Sequence[Target], signals: Sequence[Signal], least: int
) -> list[VectorChoice]:
    """Return the channels of sensors of several numbers, which are then taken."""
    free = [one for one in matches.free(signals) if not is_command(one)]
    found = vector_choices(matches.left(targets), free, ROOM, matches.unclear, least=least)
    matches.kept |= {name for one in found for name in one.sources}
    return found


def _sought(scene: Scene, episode: Episode, left: Sequence[str]) -> list[str]:
    """Return the joints without a sensor whose position channels that are not mapped may be, by their names."""
    channels = [one for one in (episode.signals[name] for name in left) if not is_command(one)]
    free = [{*words_of(one.name)} for one in channels if said_or_position(one.name) == "position"]
    joints = [(joint, {*parsed(joint).forms[2]}) for joint in unread_joints(scene)]
    return [joint for joint, words in joints if words and any(words <= name for name in free)]


def _section(kind: str, targets: Sequence[Target], matches: Matches) -> list[str]:
    """Return the lines of commands or measurements."""
    lines = []
    choices = {one.target: one for one in matches.choices}
    for choice in (choices[target] for target in targets if target in choices):
        unit, why = _unit(choice)
        guess = ", ".join(filter(None, (choice.guess, why)))
        lines += [f"[{kind}.{_quoted(choice.target.name)}]" + (f"  # guess: {guess}" if guess else "")]
        lines += [f"source = {_text(choice.signal.name)}"]
        lines += [f"unit = {_text(unit)}"] if unit else []
        lines += [""]
    for target in targets:
        if target not in choices:
            what = "source = ?" + (", or constant = ?" if kind == "action" else "")
            lines += [f"# [{kind}.{_quoted(target.name)}]  # {_missing(target, matches)}", f"# {what}", ""]
    return lines


def _missing(target: Target, matches: Matches) -> str:
    """Return that an actuator or sensor has no channel, and why where several fit."""
    why = matches.unclear.get(target, "")
    return NONE_FOUND + (f": {why}" if why else "")


def _vectors(targets: Sequence[Target], choices: Sequence[VectorChoice], matches: Matches) -> list[str]:
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
            lines += [f"# [measured.{_quoted(target.name)}]  # {_missing(target, matches)}", "# source = [?]", ""]
    return lines


def _unit(choice: Choice) -> tuple[str, str]:
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
        hit = next((one for one in free if (key := _key(body)) and key in _key(one)), None)
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


def _key(name: str) -> str:
    """Return what tells one body from another in a name."""
    return "_".join(parsed(name).forms[2])


def _text(value: str) -> str:
    """Return a text as TOML."""
    import json

    return json.dumps(value, ensure_ascii=False)


def _quoted(name: str) -> str:
    """Return a key of TOML."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _text(name)
