"""One input for a command, and how cases are built from sound inputs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

READERS = {
    "compare": "compare {}",
    "replay": "replay {} --model model.toml -o out.npz",
    "fit": "fit {} -o out --fit.generations 1",
    "events": "events {} --model model.toml -o out",
    "locate": "locate {} --png out.png",
    "diagnose": "diagnose {} --jobs 1 -o out",
    "suggest": "suggest {} --diagnosis found.json --method menu -o motion.h5",
    "add": "add joint_friction --model model.toml --target elbow --fit {} -o out.toml",
    "geometry": "geometry {} -o out.toml",
    "train": "train {} --model model.toml --device cpu -o out",
    "render": "render --recording {} -o out",
    "render-train": "render-train {} -o out --device cpu",
}
"""Command lines that read a recording."""
MODEL_READERS = {
    "compare": "compare recording.h5 --model {}",
    "replay": "replay recording.h5 --model {} -o out.npz",
    "fit": "fit recording.h5 --model {} -o out --fit.generations 1",
    "events": "events recording.h5 --model {} -o out",
    "locate": "locate recording.h5 --model {}",
    "diagnose": "diagnose recording.h5 --model {} --jobs 1 -o out",
    "add": "add joint_friction --model {} --target elbow --fit recording.h5 -o out.toml",
    "train": "train recording.h5 --model {} --device cpu -o out",
}
"""Command lines that read a model or a scene."""


@dataclass(frozen=True)
class Case:
    """One input for one command."""

    area: str
    """What the case is about: recordings, scenes, models, events, policies, options, surroundings or sound inputs."""
    name: str
    """What is wrong with the input."""
    line: str
    """The command line without "concent"; words are separated by blanks."""
    build: Callable[[Path], object] = lambda _: None
    """Changes the folder of sound inputs, which is the command's working folder."""
    accepted: bool = False
    """Whether the input is sound, so that the command is to succeed."""
    stdout: str = "file"
    """Where standard output goes: to a "file", to "full" (a full device), or it is "closed" or writes "ascii" only."""
    policy: bool = False
    """Whether the folder needs a trained policy."""

    @property
    def command(self) -> str:
        """The command."""
        return self.line.split()[0] if self.line else ""


class Rotation:
    """Gives each input to the first of some commands and, in turn, to one of the others."""

    def __init__(self, lines: dict[str, str], others: int = 1) -> None:
        """Make a rotation over command lines that have a place for the input.

        Args:
            lines: Command lines by command.
            others: How many of the commands other than the first one get each input.
        """
        self.first, *self.rest = lines.values()
        self.others, self.next = others, 0

    def lines(self, given: str) -> Iterator[str]:
        """Yield the command lines for one input."""
        yield self.first.format(given)
        for _ in range(self.others):
            yield self.rest[self.next % len(self.rest)].format(given)
            self.next += 1


def crossed(
    area: str, rotation: Rotation, inputs: Iterable[tuple[str, str, Callable[[Path], object]]]
) -> Iterator[Case]:
    """Yield cases of several commands for each input, which is a name, the path for the command, and a build."""
    for name, given, build in inputs:
        for line in rotation.lines(given):
            yield Case(area, name, line, build)


def replace_text(file: str, old: str, new: str) -> Callable[[Path], None]:
    """Return a change that replaces text in a file, which must be there."""

    def change(folder: Path) -> None:
        text = (folder / file).read_text()
        assert old in text, f"{file} does not hold {old!r}"
        (folder / file).write_text(text.replace(old, new))

    return change


def write(file: str, content: str | bytes) -> Callable[[Path], None]:
    """Return a change that writes a file."""

    def change(folder: Path) -> None:
        data = content.encode() if isinstance(content, str) else content
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(data)

    return change


def several(*changes: Callable[[Path], object]) -> Callable[[Path], None]:
    """Return a change that makes several in turn."""

    def change(folder: Path) -> None:
        for one in changes:
            one(folder)

    return change


def flip_byte(file: str, share: float = 0.5) -> Callable[[Path], None]:
    """Return a change that flips all bits of the byte at a share of a file's length."""

    def change(folder: Path) -> None:
        data = bytearray((folder / file).read_bytes())
        data[int(len(data) * share)] ^= 255
        (folder / file).write_bytes(data)

    return change


def truncate(file: str, share: float = 0.5) -> Callable[[Path], None]:
    """Return a change that keeps a share of a file."""

    def change(folder: Path) -> None:
        data = (folder / file).read_bytes()
        (folder / file).write_bytes(data[: int(len(data) * share)])

    return change


class Code:
    """An object whose pickle would make a file called "executed" when it is loaded."""

    def __reduce__(self) -> tuple[Callable[[str], object], tuple[Path]]:
        """Return the call that a pickle names."""
        return Path.touch, (Path("executed"),)  # type: ignore[return-value]
