"""What the settings of a command are called as options."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from typing import Any, get_type_hints

import tyro


def option_namer(arguments: type) -> Callable[[str, type], str]:
    """Return a function that gives the option, such as "--fit.held-out", for the dotted name of a setting.

    Its second argument is the class of the settings in which the name begins; where that is not a part of the
    command's, or several parts are of that class, it returns the dotted name itself.

    Args:
        arguments: Dataclass of a command.
    """
    names = dict(options_of(arguments))
    parts = [("", arguments), *_parts(arguments)]

    def option(setting: str, kind: type) -> str:
        prefixes = [prefix for prefix, part in parts if part is kind]
        return names.get(f"{prefixes[0]}{setting}", setting) if len(prefixes) == 1 else setting

    return option


def _parts(kind: type, setting: str = "") -> Iterator[tuple[str, type]]:
    """Yield the dotted name of each dataclass in a dataclass, with a dot at the end, and its class."""
    hints = get_type_hints(kind)
    for field in fields(kind):
        inner = hints[field.name]
        if is_dataclass(inner) and isinstance(inner, type):
            yield f"{setting}{field.name}.", inner
            yield from _parts(inner, f"{setting}{field.name}.")


def options_of(
    kind: type, setting: str = "", prefix: str = "--", *, omitted: bool = False
) -> Iterator[tuple[str, str]]:
    """Yield the dotted name of each setting of a dataclass and its option.

    Args:
        kind: Dataclass.
        setting: Dotted name of what holds it, with a dot at the end.
        prefix: What its options begin with.
        omitted: Whether those within it begin with the same.
    """
    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        hint = hints[field.name]
        marks = getattr(hint, "__metadata__", ())
        given = next((mark.name for mark in marks if isinstance(getattr(mark, "name", None), str)), None)
        name = field.name.replace("_", "-") if given is None else given
        inner: Any = hint.__origin__ if marks else hint
        if is_dataclass(inner) and isinstance(inner, type):
            within = omitted or tyro.conf.OmitArgPrefixes in marks
            longer = prefix if within or not name else f"{prefix}{name}."
            yield from options_of(inner, f"{setting}{field.name}.", longer, omitted=within)
        else:
            positional = tyro.conf.Positional in marks
            yield f"{setting}{field.name}", name.upper() if positional else f"{prefix}{name}"
