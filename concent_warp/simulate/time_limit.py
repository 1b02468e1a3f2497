"""A time at which simulations stop: what takes longer raises an error, and its caller goes on with what is there."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_deadline: ContextVar[float | None] = ContextVar("time at which simulations stop", default=None)


class TimeUpError(RuntimeError):
    """The time that was given for simulations is over."""


def deadline() -> float | None:
    """Return when simulations of C MuJoCo stop [s since the epoch], None where they may take as long as they do.

    It is a time of day, which other processes and hosts have too.
    """
    return _deadline.get()


@contextmanager
def stop_at(when: float | None) -> Iterator[None]:
    """Let simulations within stop at a time [s since the epoch], or at an earlier one that is set; None keeps it."""
    before = _deadline.get()
    token = _deadline.set(before if when is None else when if before is None else min(before, when))
    try:
        yield
    finally:
        _deadline.reset(token)


@contextmanager
def unlimited() -> Iterator[None]:
    """Let simulations within take as long as they do: few, of which what is found already has need."""
    token = _deadline.set(None)
    try:
        yield
    finally:
        _deadline.reset(token)


def time_check() -> Callable[[], None]:
    """Return a function for this and other threads that raises an error once the deadline is over.

    Raises:
        TimeUpError: It is over already.
    """
    end = _deadline.get()

    def check() -> None:
        if end is not None and time.time() >= end:
            raise TimeUpError("the time for simulations is over")

    check()
    return check
