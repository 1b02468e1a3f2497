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
Variant = tuple[Any, Any, int]
"""A module, the device and the threads of a block that it is compiled for."""

_collecting = threading.Lock()


def load_modules(launches: Callable[[], None]) -> None:
    """Compile and load the modules of all kernels that a function launches, several at a time.

    The function is called once; nothing is launched in it, while copies and allocations are made. Bodies of
    ``wp.capture_while`` and both branches of ``wp.capture_if`` are gone through once. What it launches must not depend
    on values that kernels compute. Kernels that are missed so are compiled at their first launch.
    """
    try:
        variants = launched_modules(launches)
    except Exception:
        return  # what is wrong is said by the launches themselves, which follow
    workers = min(COMPILERS, simulations_at_a_time(), len(variants))
    if workers < 2:
        return
    with ThreadPoolExecutor(workers) as pool:
        for made in [pool.submit(module.load, device, block_dim=size) for module, device, size in variants]:
            made.result()


def launched_modules(launches: Callable[[], None]) -> list[Variant]:
    """Return the modules of the kernels that a function would launch, without launching them."""
    found: dict[tuple[int, str, int], Variant] = {}

    def note(module: Any, device: Any, block_dim: int | None = None, **_: object) -> None:
        # A launch whose module is None returns at once; overloads of generic kernels are made before.
        size = module.options["block_dim"] if block_dim is None else block_dim
        found.setdefault((id(module), str(device), size), (module, device, size))

    def suggested_block_size(kernel: Any, device: Any = None) -> tuple[int, int]:
        # What depends on it is how many threads are launched, not which kernels.
        if not wp.get_device(device).is_cuda:
            return 1, 1
        note(kernel.module, wp.get_device(device))
        return 256, 1

    patched = mock.patch.object(wp.Module, "load", note)
    with (
        _collecting,
        _branches_taken(),
        patched,
        mock.patch.object(wp, "get_suggested_block_size", suggested_block_size),
    ):
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
