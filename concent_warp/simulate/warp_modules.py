"""Warp modules compiled side by side before their first launch.

Warp compiles a module when one of its kernels is first launched, one after the other, and again when a generic kernel
of it is launched with further types. A step of MuJoCo-Warp launches kernels of some fifty modules.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from unittest import mock

import warp as wp

from concent_warp.simulate.parallel import simulations_at_a_time

COMPILERS = 16
"""Largest number of modules compiled at a time; a compiler takes up to 0.5 GB."""
Variant = tuple[Any, Any, int | None]
"""A module, the device and the threads of a block that it is compiled for."""

_collecting = threading.Lock()


def load_modules(launches: Callable[[], None]) -> None:
    """Compile and load the modules of all kernels that a function launches, several at a time.

    The function is called once; nothing is launched in it, while copies and allocations are made. Bodies of
    ``wp.capture_while`` and both branches of ``wp.capture_if`` are gone through once. What it launches must not depend
    on values that kernels compute. Kernels that are missed so are compiled at their first launch.
    """
    variants = launched_modules(launches)
    workers = min(COMPILERS, simulations_at_a_time(), len(variants))
    if workers < 2:
        return
    with ThreadPoolExecutor(workers) as pool:
        for made in [pool.submit(module.load, device, block_dim=size) for module, device, size in variants]:
            made.result()


def launched_modules(launches: Callable[[], None]) -> list[Variant]:
    """Return the modules of the kernels that a function would launch, without launching them."""
    found: dict[tuple[int, str, int | None], Variant] = {}

    def note(module: Any, device: Any, block_dim: int | None = None, **_: object) -> None:
        # A launch whose module is None returns at once; overloads of generic kernels are made before.
        found.setdefault((id(module), str(device), block_dim), (module, device, block_dim))

    with _collecting, _branches_taken(), mock.patch.object(wp.Module, "load", note):
        launches()
    return list(found.values())


@contextlib.contextmanager
def _branches_taken() -> Iterator[None]:
    """Go once through the bodies of conditions on the device."""

    def branches(*arguments: object, **given: object) -> None:
        named = [given.pop(name, None) for name in ("condition", "stream", "while_body", "on_true", "on_false")]
        for body in (*arguments, *named):
            if callable(body):  # neither the condition nor a graph, which holds kernels that are loaded already
                body(**given)

    with mock.patch.object(wp, "capture_while", branches), mock.patch.object(wp, "capture_if", branches):
        yield
