"""Checks of settings that many functions share: seeds, devices and numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from typing import Annotated, Any, get_args, get_type_hints

from concent_warp.errors import ConcentError

MAX_SEED = 2**32 - 1
"""Largest seed that NumPy's and torch's generators all take."""
MAX_NUMBER = 1e9
"""Largest number that any setting may be, unless its bounds say otherwise."""
MAX_COUNT = 10_000_000
"""Largest number of things."""
SEEDS = ("seed", "seeds", "unseen_seeds")
"""Names of settings that are seeds."""


def check_seed(seed: float, error: type[ConcentError] = ConcentError, name: str = "the seed") -> None:
    """Raise an error unless a seed is one that all random number generators take; `name` is what to call it."""
    if not 0 <= seed <= MAX_SEED:
        raise error(f"{name} is out of bounds", expected=f"0 to {MAX_SEED}", found=_short(seed))


def check_device(name: str | None) -> None:
    """Check that there is a device, by Warp's or torch's name; None stands for the one that is taken by default.

    Raises:
        ConcentError: The name is no device, or there are fewer CUDA devices.
    """
    if name is None or name == "cpu":
        return
    named = re.fullmatch(r"cuda(?::(\d{1,4}))?", name)
    if named is None:
        raise ConcentError("no such device", expected='"cpu" or "cuda:0"', found=repr(name))
    import torch

    count = torch.cuda.device_count()
    if int(named[1] or 0) >= count:
        found = "no CUDA device" if count == 0 else f"{count} CUDA device{'s' * (count > 1)}"
        expected = " or ".join(['"cpu"', *(f'"cuda:{k}"' for k in range(count))])
        raise ConcentError(f"there is no device {name}", expected=expected, found=found)


def check_at_least(least: float, error: type[ConcentError] = ConcentError, **values: float | None) -> None:
    """Raise an error unless values are finite and at least a number, those that are None aside; `values` by name."""
    for name, value in values.items():
        if value is not None and not (math.isfinite(value) and value >= least):
            raise error(f"{name} is out of bounds", expected=f"at least {least:g}", found=value)


@dataclass(frozen=True)
class Bounds:
    """Bounds of a setting, as metadata of its type; of a tuple or a mapping they hold for each number in it."""

    low: float = 0.0
    """Smallest value."""
    high: float = MAX_NUMBER
    """Largest value."""
    above_low: bool = False
    """Whether the smallest value itself is excluded."""
    below_high: bool = False
    """Whether the largest value itself is excluded."""
    excluded: float | None = None
    """A value within that is not allowed."""
    ascending: bool = False
    """Whether the numbers of a tuple must not decrease."""

    def include(self, value: float) -> bool:
        """Return whether a number is within the bounds."""
        low = value > self.low if self.above_low else value >= self.low
        return low and (value < self.high if self.below_high else value <= self.high) and value != self.excluded

    def sentence(self) -> str:
        """Return the bounds in words, such as "above 0 and at most 1"."""
        low, high = "above" if self.above_low else "at least", "below" if self.below_high else "at most"
        but = "" if self.excluded is None else f", but not {self.excluded:g}"
        return f"{low} {self.low:g} and {high} {self.high:g}{but}"


NOT_NEGATIVE = Bounds()
"""Bounds of numbers that declare none."""
Positive = Annotated[float, Bounds(above_low=True)]
"""A number above 0."""
Signed = Annotated[float, Bounds(-MAX_NUMBER)]
"""A number of either sign."""
Factor = Annotated[float, Bounds(1)]
"""A factor of at least 1."""
Interval = Annotated[tuple[float, float], Bounds(ascending=True)]
"""A smallest and a largest value."""
PositiveInterval = Annotated[tuple[float, float], Bounds(above_low=True, ascending=True)]
"""A smallest and a largest value above 0."""
Share = Annotated[float, Bounds(0, 1)]
"""A number from 0 to 1."""
PositiveShare = Annotated[float, Bounds(0, 1, above_low=True)]
"""A number above 0 and at most 1."""
SmallShare = Annotated[float, Bounds(0, 1, below_high=True)]
"""A number from 0 to below 1."""
OpenShare = Annotated[float, Bounds(0, 1, above_low=True, below_high=True)]
"""A number above 0 and below 1."""
Angle = Annotated[float, Bounds(0, 180)]
"""An angle between two directions [deg]."""
OpenAngle = Annotated[float, Bounds(0, 180, above_low=True, below_high=True)]
"""The angle of a field of view [deg]."""
Turn = Annotated[float, Bounds(-2 * math.pi, 2 * math.pi)]
"""A rotation about an axis [rad]."""
Place = Annotated[float, Bounds(-1000, 1000)]
"""A coordinate in a scene [m]."""
Length = Annotated[float, Bounds(0, 1000, above_low=True)]
"""A size of an object [m]."""
Duration = Annotated[float, Bounds(0, 1e6)]
"""A time that may be 0 [s]."""
PositiveDuration = Annotated[float, Bounds(0, 1e6, above_low=True)]
"""A time [s]."""
WindowLength = Annotated[float, Bounds(1e-3, 1e6)]
"""Length of pieces of a demonstration that are simulated or averaged on their own [s]."""
TimeStep = Annotated[float, Bounds(1e-6, 1)]
"""Time step of a simulation [s]."""
Rate = Annotated[float, Bounds(0.001, 1e5)]
"""Events in a second [Hz]."""
Count = Annotated[int, Bounds(1, MAX_COUNT)]
"""A number of things of which there is at least one."""
Pixels = Annotated[int, Bounds(1, 16_384)]
"""An edge of an image [px]."""
Worlds = Annotated[int, Bounds(1, 1_000_000)]
"""A number of simulations in parallel."""
_option_names: ContextVar[Callable[[str, type], str]] = ContextVar("_option_names", default=lambda name, _: name)


@contextmanager
def named_as(option: Callable[[str, type], str]) -> Iterator[None]:
    """Let `check_settings` call a setting, in its messages, what a function returns for its dotted name.

    The function also gets the class of the settings that the dotted name begins in.
    """
    token = _option_names.set(option)
    try:
        yield
    finally:
        _option_names.reset(token)


def check_settings(settings: Any, error: type[ConcentError] = ConcentError) -> None:
    """Check what holds for every tree of settings: numbers are within their bounds, seeds and devices are possible.

    Args:
        settings: A dataclass; the types of its fields, and of those of the dataclasses in it, may have `Bounds`.
            Numbers without are to be at least 0.
        error: What is raised.

    Raises:
        ConcentError: A setting is not possible.
    """
    for name, value, bounds in _settings(settings):
        option = _option_names.get()(name, type(settings))
        last = name.split(".")[-1]
        if isinstance(value, int | float) and not isinstance(value, bool):
            if bounds is None and last in SEEDS:
                check_seed(value, error, option)
            else:
                _check_number(option, value, bounds or NOT_NEGATIVE, error)
        elif last == "device" and (value is None or isinstance(value, str)):
            check_device(value)
        elif bounds is not None and bounds.ascending and isinstance(value, tuple) and list(value) != sorted(value):
            raise error(f"{option} is out of bounds", expected="a smallest and a largest value", found=value)


def _check_number(name: str, value: float, bounds: Bounds, error: type[ConcentError]) -> None:
    """Raise an error unless a number is within bounds."""
    if value != value:  # NaN; integers may be too long for math.isnan
        raise error(f"{name} is not a number", expected="a number", found="nan")
    if not bounds.include(value):
        raise error(f"{name} is out of bounds", expected=bounds.sentence(), found=_short(value))


def _short(value: float) -> object:
    """Return a number as a message may show it."""
    return value if isinstance(value, float) or abs(value) < 10**20 else "a longer number"


def _settings(value: Any, name: str = "", bounds: Bounds | None = None) -> Iterator[tuple[str, Any, Bounds | None]]:
    """Yield the settings of a tree by dotted names, with their bounds; items by the name of their list or mapping."""
    if is_dataclass(value) and not isinstance(value, type):
        for field, declared in _bounds_of(type(value)).items():
            yield from _settings(getattr(value, field), f"{name}.{field}".lstrip("."), declared)
        return
    if isinstance(value, list | tuple):
        for item in value:
            yield from _settings(item, name, bounds)
    elif isinstance(value, Mapping):
        for item in value.values():
            yield from _settings(item, name, bounds)
    yield name, value, bounds


@cache
def _bounds_of(kind: type) -> dict[str, Bounds | None]:
    """Return the bounds of each field of a dataclass, None where it declares none."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: _declared(hints[field.name]) for field in fields(kind)}


def _declared(hint: Any) -> Bounds | None:
    """Return the bounds that a type has, or one of those that it is made of."""
    found = [one for one in getattr(hint, "__metadata__", ()) if isinstance(one, Bounds)]
    return next(iter(found), None) or next(filter(None, map(_declared, get_args(hint))), None)
