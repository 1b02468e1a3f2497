"""Checks of settings that many functions share: seeds, devices and numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

from concent_warp.errors import ConcentError

MAX_SEED = 2**32 - 1
"""Largest seed that NumPy's and torch's generators all take."""
SEEDS = ("seed", "seeds", "unseen_seeds")
"""Names of settings that are seeds."""


def check_seed(seed: int, error: type[ConcentError] = ConcentError) -> None:
    """Raise an error unless a seed is one that all random number generators take."""
    if not 0 <= seed <= MAX_SEED:
        found = seed if abs(seed) < 10**20 else "a longer number"
        raise error("the seed is out of bounds", expected=f"0 to {MAX_SEED}", found=found)


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


def check_settings(settings: Any) -> None:
    """Check what holds for every tree of settings: no number is NaN, seeds and devices are possible.

    Raises:
        ConcentError: A setting is not possible.
    """
    for name, value in _settings(settings):
        last = name.split(".")[-1]
        if isinstance(value, float) and math.isnan(value):
            raise ConcentError(f"{name} is not a number", expected="a number", found="nan")
        if last in SEEDS and isinstance(value, int):
            check_seed(value)
        if last == "device" and (value is None or isinstance(value, str)):
            check_device(value)


def _settings(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the settings of a tree by their dotted names, each item of a list by the name of the list."""
    if is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _settings(getattr(value, field.name), f"{name}.{field.name}".lstrip("."))
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _settings(item, name)
    else:
        yield name, value
