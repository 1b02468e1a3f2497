"""Strict reading of dataclasses from parsed JSON: no wrong type, nothing unknown, nothing missing without a default."""

from __future__ import annotations

import types
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from concent_warp.documents import is_number
from concent_warp.errors import EventsError

T = TypeVar("T")


def decode(kind: type[T], value: Any, where: str) -> T:
    """Return an instance of the dataclass `kind` from `value`, as `dataclasses.asdict` and JSON leave it.

    Fields may be dataclasses, tuples, literals, optional values, text, whole and real numbers.

    Raises:
        EventsError: `value` does not fit; the message says at which field.
    """
    return _decode_value(kind, value, where)


def _decode_value(kind: Any, value: Any, where: str) -> Any:
    """Return `value` as a `kind`, see `decode`."""
    if is_dataclass(kind):
        return _decode_fields(kind, value, where)
    origin, options = get_origin(kind), get_args(kind)
    if origin is tuple:
        return _decode_tuple(options, value, where)
    if origin in (Union, types.UnionType):
        inner = next(option for option in options if option is not type(None))
        return None if value is None else _decode_value(inner, value, where)
    if origin is Literal:
        if value not in options:
            raise EventsError("unknown value", where=where, expected=f"one of {list(options)}", found=repr(value))
        return value
    if kind is float and is_number(value):
        return float(value)
    if kind is not float and type(value) is kind:
        return value
    words = {float: "a finite number", int: "a whole number", str: "text"}
    raise EventsError("wrong type of value", where=where, expected=words[kind], found=repr(value)[:60])


def _decode_fields(kind: Any, value: Any, where: str) -> Any:
    """Return a dataclass from a JSON object."""
    if not isinstance(value, dict):
        raise EventsError("wrong type of value", where=where, expected="an object", found=repr(value)[:60])
    known = {field.name: field for field in fields(kind)}
    if unknown := sorted(set(value) - set(known)):
        raise EventsError("unknown entries", where=where, expected=f"only {list(known)}", found=unknown[:5])
    needed = [name for name, field in known.items() if field.default is MISSING and field.default_factory is MISSING]
    if missing := [name for name in needed if name not in value]:
        raise EventsError("missing entries", where=where, expected=f"all of {needed}", found=f"no {missing}")
    hints = get_type_hints(kind)
    return kind(**{name: _decode_value(hints[name], item, f"{where}, {name}") for name, item in value.items()})


def _decode_tuple(options: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    """Return a tuple from a JSON list; `options` are its element types, or one type and an ellipsis."""
    if not isinstance(value, list):
        raise EventsError("wrong type of value", where=where, expected="a list", found=repr(value)[:60])
    if len(options) == 2 and options[1] is Ellipsis:
        return tuple(_decode_value(options[0], item, f"{where}[{i}]") for i, item in enumerate(value))
    if len(value) != len(options):
        raise EventsError("wrong length of list", where=where, expected=len(options), found=len(value))
    pairs = zip(options, value, strict=True)
    return tuple(_decode_value(option, item, f"{where}[{i}]") for i, (option, item) in enumerate(pairs))
