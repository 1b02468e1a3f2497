"""Settings by their dotted names: as options of a command, and put into a configuration."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

T = TypeVar("T")


def with_settings(cfg: T, settings: Mapping[str, Any]) -> T:
    """Return a configuration with some settings changed; names are dotted, such as ``ppo.iterations``."""
    for name, value in settings.items():
        cfg = _with_one(cfg, name.split("."), value)
    return cfg


def _with_one(cfg: Any, path: list[str], value: Any) -> Any:
    """Return a configuration with the setting at a path changed."""
    first, rest = path[0], path[1:]
    return replace(cfg, **{first: _with_one(getattr(cfg, first), rest, value) if rest else value})


def changed_settings(cfg: Any, default: Any, prefix: str = "") -> dict[str, Any]:
    """Return the settings in which a configuration differs from another one of its class, by dotted name."""
    found: dict[str, Any] = {}
    for field in fields(cfg):
        mine, other, name = getattr(cfg, field.name), getattr(default, field.name), f"{prefix}{field.name}"
        if is_dataclass(mine) and type(mine) is type(other):
            found |= changed_settings(mine, other, f"{name}.")
        elif mine != other:
            found[name] = mine
    return found


def as_options(settings: Mapping[str, Any]) -> str:
    """Return settings as options of the command line, such as ``--ppo.learning-rate 0.001``."""
    return " ".join(_option(name.replace("_", "-"), value) for name, value in settings.items())


def _option(name: str, value: Any) -> str:
    """Return one option."""
    if isinstance(value, bool):
        group, _, own = name.rpartition(".")
        switch = own if value else f"no-{own}"
        return f"--{group}.{switch}" if group else f"--{switch}"
    values = value if isinstance(value, tuple | list) else [value]
    return " ".join([f"--{name}", *(shlex.quote(str(one)) for one in values)])
