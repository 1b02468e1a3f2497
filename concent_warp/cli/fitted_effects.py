"""What the commands say of fitted effects."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from rich.markup import escape

from concent_warp.cli.terminal import quiet_warp, say, status_bar

if TYPE_CHECKING:
    from collections.abc import Callable

    from concent_warp.effects.effect import AddedEffect
    from concent_warp.fit.effects.fit import FittedEffects
    from concent_warp.fit.effects.intervals import FittedParameter


@contextmanager
def work_progress(title: str, seconds: float | None = None) -> Iterator[Callable[[float, str], None]]:
    """Show a bar; what is given is to be called with the share done, 0..1, and what is being done.

    Args:
        title: Of the bar.
        seconds: Time after which the work ends at the latest [s].
    """
    quiet_warp()
    begun = time.monotonic()
    with status_bar(title) as update:
        yield lambda share, text: update(share, text, time_left(share, time.monotonic() - begun, seconds))


def time_left(share: float, spent: float, seconds: float | None) -> float | None:
    """Return the time left [s] of work that ends after some seconds at the latest; None where it has no end.

    Args:
        share: Share that is done, 0..1.
        spent: Time spent [s].
        seconds: Time after which it ends [s].
    """
    if seconds is None:
        return None
    most = max(seconds - spent, 0.0)
    return most if share <= 0 else min(most, spent * (1 - share) / share)


def _number(value: float, step: float = 0.0) -> str:
    """Return a parameter's value as text, with digits enough for differences of `step`."""
    from concent_warp.comparison.units import number_text

    return number_text(value, 4, step) if np.isfinite(value) else "none" if value > 0 else "-none"


def _value_and_ends(p: FittedParameter) -> tuple[str, str, str]:
    """Return the value of a parameter and the ends of its interval as text."""
    from concent_warp.comparison.units import readable_step

    step = readable_step(p.value, p.low, p.high)
    return _number(p.value, step), _number(p.low, step), _number(p.high, step)


def value_and_interval(p: FittedParameter, *, owner: bool = False) -> str:
    """Return a parameter as text, such as ``torque 0.0301 [0.0298, 0.0305] N m``, and its owner if asked."""
    from concent_warp.effects.effect import with_unit

    name = p.name if owner else p.name.split("[")[0]
    value, low, high = _value_and_ends(p)
    return with_unit(f"{name} {value} [{low}, {high}]", p.unit)


def say_fitted(fitted: FittedEffects) -> None:
    """Write a table of all parameters with their intervals, how far the error has fallen, and what is doubtful."""
    from rich.table import Table

    table = Table(header_style="bold")
    for name in ("effect", "parameter", "value", "95 % interval", "unit", "null"):
        table.add_column(name, justify="right" if name in ("value", "95 % interval", "null") else "left")
    for added, group in zip(fitted.model.effects, fitted.parameters, strict=True):
        for k, p in enumerate(group):
            value, low, high = _value_and_ends(p)
            cells = [added.effect.name if k == 0 else "", p.name, value, f"{low} to {high}", p.unit, _number(p.null)]
            table.add_row(*map(escape, cells), end_section=k + 1 == len(group))
    say(table)
    table = Table(header_style="bold")
    for name in ("x noise", "before", "after"):
        table.add_column(name, justify="left" if name == "x noise" else "right")
    for channel in fitted.channels:
        table.add_row(escape(channel.channel), f"{channel.before:.2f}", f"{channel.after:.2f}")
    table.add_section()
    table.add_row("all", f"{fitted.before:.2f}", f"{fitted.after:.2f}")
    say(table)
    for remark in fitted.remarks:
        say(escape(remark))


def say_added(effects: Sequence[AddedEffect], names: Sequence[Sequence[str]]) -> None:
    """Write the values that effects were added with; `names` are those of their parameters with units."""
    for added, parameters in zip(effects, names, strict=True):
        values = ", ".join(f"{name} {_number(value)}" for name, value in zip(parameters, added.values, strict=True))
        say(escape(f"{added.effect.name}: {values}"))
