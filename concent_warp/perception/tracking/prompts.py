"""Where a user says that bodies are: a click on each, or a box around it, in the first frame of a camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from concent_warp.documents import is_number, read_json, read_toml
from concent_warp.errors import RecordingError
from concent_warp.perception.tracking.alignment.clusters import Region
from concent_warp.perception.tracking.video import Video

KINDS = {"click": 2, "box": 4}
"""Kinds of prompts and how many numbers each has."""
FORMS = {"click": "BODY=COLUMN,ROW or BODY=COLUMN,ROW@CAMERA", "box": "BODY=LEFT,TOP,RIGHT,BOTTOM[@CAMERA]"}
"""How each is written on the command line."""

Entries = Mapping[str, Any]
"""Prompts as a user gives them: by body, or by demonstration and body, tables with click or box, and camera."""


@dataclass(frozen=True)
class Prompt:
    """A place in the image of one stream of a video."""

    stream: int
    """Number of the stream in the video."""
    region: Region

    def regions(self, frames: Sequence[tuple[int, int]]) -> tuple[Region | None, ...]:
        """Return the region in each of a moment's frames (stream, frame); None in those of other cameras."""
        return tuple(self.region if stream == self.stream else None for stream, _ in frames)


def written_prompts(clicks: Sequence[str], boxes: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the prompts, by body, that are written as ``block=312,240@front`` and ``block=280,210,350,270``.

    Raises:
        RecordingError: One is not of this form, or a body has two.
    """
    found: dict[str, dict[str, Any]] = {}
    for kind, texts in (("click", clicks), ("box", boxes)):
        for text in texts:
            body, equals, rest = text.partition("=")
            place, at, camera = rest.partition("@")
            try:
                numbers = [float(part) for part in place.split(",")]
            except ValueError:
                numbers = []
            if not body or not equals or len(numbers) != KINDS[kind] or (at and not camera):
                raise RecordingError(f"--{kind} is not right", expected=FORMS[kind], found=text)
            if body in found:
                raise RecordingError(
                    f"{body!r} has two prompts", expected="one click or one box of each body", found=text
                )
            found[body] = {kind: numbers} | ({"camera": camera} if at else {})
    return found


def given_prompts(given: str | Path | Entries | None) -> Entries:
    """Return prompts as they are given, or read from a TOML or JSON file.

    Raises:
        RecordingError: The file cannot be read or has no tables.
    """
    if given is None:
        return {}
    where = "prompts"
    if isinstance(given, str | Path):
        path = where = Path(given)
        given = read_json(path, RecordingError) if path.suffix == ".json" else read_toml(path, RecordingError)
    if not isinstance(given, Mapping) or not all(isinstance(entry, Mapping) for entry in given.values()):
        raise RecordingError(
            "prompts are not right", where=where, expected="[body] with click or box, or [demonstration.body]"
        )
    return given


def check_names(entries: Entries, demonstrations: Sequence[str], bodies: Sequence[str]) -> None:
    """Check that prompts are of demonstrations and bodies that there are.

    Raises:
        RecordingError: One is not.
    """
    for name, entry in entries.items():
        if _is_prompt(entry):
            _check_body(name, bodies)
            continue
        if name not in demonstrations:
            raise RecordingError(
                "a prompt is of nothing that is tracked",
                expected=f"a body, of {list(bodies)}, with click or box, or a demonstration, of {list(demonstrations)}",
                found=name,
            )
        for body in entry:
            _check_body(body, bodies)


def _check_body(name: str, bodies: Sequence[str]) -> None:
    """Raise an error unless a body is tracked."""
    if name not in bodies:
        raise RecordingError("a prompt of a body that is not tracked", expected=f"some of {list(bodies)}", found=name)


def video_prompts(entries: Entries, demonstration: str, video: Video, where: str) -> dict[str, Prompt]:
    """Return the prompts of one demonstration by body; those of a demonstration go before those of all.

    Args:
        entries: See `given_prompts`.
        demonstration: Its name.
        video: Its frames.
        where: File and demonstration, for messages.

    Raises:
        RecordingError: A prompt has not the right numbers, lies outside the image, or names no camera of several.
    """
    own = entries.get(demonstration, {})
    chosen = {name: entry for name, entry in entries.items() if _is_prompt(entry)}
    chosen |= {} if _is_prompt(own) else own
    return {body: _prompt(entry, video, f"{where}, prompt of {body!r}") for body, entry in chosen.items()}


def without_prompted(
    first: Mapping[str, Any], prompts: Mapping[str, Prompt], where: str, *, initial: bool
) -> dict[str, Any]:
    """Return the first poses of bodies that have no prompt.

    Args:
        first: First poses by body.
        prompts: Prompts by body.
        where: For messages.
        initial: Whether the poses are those of the recording's initial state, which prompts replace.

    Raises:
        RecordingError: A body has a prompt and a pose that was given for it.
    """
    if not initial and (both := sorted(set(first) & set(prompts))):
        raise RecordingError("a body has a first pose and a prompt", where=where, expected="one of them", found=both)
    return {body: pose for body, pose in first.items() if body not in prompts}


def _is_prompt(entry: Any) -> bool:
    """Return whether an entry is a body's, not a demonstration's."""
    return not isinstance(entry, Mapping) or any(kind in entry for kind in KINDS) or not entry


def _prompt(entry: Any, video: Video, where: str) -> Prompt:
    """Return one prompt, checked against the camera's image."""
    kinds = [kind for kind in KINDS if isinstance(entry, Mapping) and kind in entry]
    unknown = sorted(set(entry) - {*KINDS, "camera"}) if isinstance(entry, Mapping) else []
    if len(kinds) != 1 or unknown:
        raise RecordingError(
            "a prompt is not right", where=where, expected="click or box, and camera where there are several",
            found=unknown or kinds or entry,
        )  # fmt: skip
    kind = kinds[0]
    numbers = entry[kind]
    if not isinstance(numbers, list | tuple) or len(numbers) != KINDS[kind] or not all(map(is_number, numbers)):
        raise RecordingError(f"{kind} is not right", where=where, expected=f"{KINDS[kind]} numbers", found=numbers)
    stream = _stream(entry.get("camera"), video, where)
    height, width = video.streams[stream].depth.shape[1:]
    limits = [width - 1, height - 1] * (KINDS[kind] // 2)
    if not all(0 <= value <= limit for value, limit in zip(numbers, limits, strict=True)):
        raise RecordingError(
            f"a {kind} outside the image",
            where=where,
            expected=f"columns 0 to {width - 1}, rows 0 to {height - 1}",
            found=", ".join(f"{value:g}" for value in numbers),
        )
    if kind == "click":
        return Prompt(stream, Region(click=(float(numbers[0]), float(numbers[1]))))
    left, top, right, bottom = map(float, numbers)
    if left >= right or top >= bottom:
        raise RecordingError(
            "a box without area", where=where, expected="left < right and top < bottom",
            found=", ".join(f"{value:g}" for value in numbers),
        )  # fmt: skip
    return Prompt(stream, Region(box=(left, top, right, bottom)))


def _stream(camera: Any, video: Video, where: str) -> int:
    """Return the number of a camera's stream; of the only one where none is named."""
    if camera is None and len(video.cameras) == 1:
        return 0
    if camera not in video.cameras:
        raise RecordingError(
            "a prompt names no camera of several" if camera is None else "a prompt names no camera of the video",
            where=where,
            expected=f"one of {list(video.cameras)}",
            found="none" if camera is None else camera,
        )
    return list(video.cameras).index(camera)
