"""How many simulations run at a time in this process: one for each CPU, or fewer where others share the CPUs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_most: ContextVar[int | None] = ContextVar("most simulations at a time", default=None)


def simulations_at_a_time() -> int:
    """Return how many simulations an engine of C MuJoCo runs at a time unless told otherwise."""
    return min(len(os.sched_getaffinity(0)), _most.get() or 2**31)


@contextmanager
def at_most(count: int | None) -> Iterator[None]:
    """Let engines that are made within run `count` simulations at a time at most; None leaves it as it is."""
    token = _most.set(_most.get() if count is None else max(count, 1))
    try:
        yield
    finally:
        _most.reset(token)
