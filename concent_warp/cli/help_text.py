"""Help of a command: the options that matter for every run, and the rest where it is asked for."""

from __future__ import annotations

import io
import re
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any

from concent_warp.cli.terminal import WIDTH

ALL = "--help-all"
"""Option that shows all options."""
STYLE = re.compile(r"\x1b\[[0-9;]*m")
"""Colours and weights of a terminal."""
TITLE = re.compile(r"((?:[\w.-]+ )?(?:options|arguments))")
"""Title of a group of options."""


class _Kept(io.StringIO):
    """Text that is kept, written as for the standard output."""

    def __init__(self, output: Any) -> None:
        super().__init__()
        self._output = output

    @property
    def encoding(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return getattr(self._output, "encoding", None) or "utf-8"

    def isatty(self) -> bool:
        return self._output.isatty()


@contextmanager
def readable_help(command: str, *, everything: bool) -> Iterator[None]:
    """Print what help tyro writes within the context in lines of 80 columns, and unless asked for without some groups.

    Args:
        command: Name of the command, such as "fit".
        everything: Whether the groups of advanced settings are shown.
    """
    kept = _Kept(sys.stdout)
    try:
        with redirect_stdout(kept):
            yield
    finally:
        if text := kept.getvalue():
            print(wrapped_description(text if everything else main_help(text, command)), end="")


def main_help(text: str, command: str) -> str:
    """Return a help text without the groups after the first two, which are listed by name instead.

    Args:
        text: Help of all options, in groups, as tyro writes it: in frames, or under rulers where there is no UTF-8.
        command: Name of the command, such as "fit".
    """
    lines = text.splitlines(keepends=True)
    advanced = [(k, title) for k, title in _groups(lines) if title not in ("positional arguments", "options")]
    if not advanced:
        return text
    names = [title.removesuffix(" options") for _, title in advanced]
    shown = "".join(lines[: advanced[0][0]])
    listed = textwrap.fill(", ".join(names), WIDTH, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False)
    return f"{shown}\nadvanced settings, shown by concent {command} {ALL}:\n{listed}\n"


def wrapped_description(text: str) -> str:
    """Return a help text whose lines before the groups have at most 80 columns, an example excepted."""
    lines = text.splitlines(keepends=True)
    first = next((k for k, _ in _groups(lines)), 0)
    long = (line if line.startswith("Example:") else textwrap.fill(line, WIDTH) + "\n" for line in lines[:first])
    return "".join([*long, *lines[first:]])


def _groups(lines: list[str]) -> Iterator[tuple[int, str]]:
    """Yield the rows in which groups of options begin, and their titles."""
    for k, line in enumerate(lines):
        title = _title(line, lines[k + 1 : k + 2])
        if title is not None:
            yield k, title


def _title(line: str, following: list[str]) -> str | None:
    """Return the title of the group of options that begins with a line, None if none does."""
    plain = STYLE.sub("", line).strip()
    framed = plain.startswith("╭")
    ruled = bool(following) and not STYLE.sub("", following[0]).strip().strip("-") and following[0].strip() != ""
    found = TITLE.fullmatch(plain.strip("╭─╮ "))
    return found[1] if found and (framed or ruled) else None
