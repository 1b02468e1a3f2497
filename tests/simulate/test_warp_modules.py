"""Modules are compiled before the first launch, all of them, and nothing is simulated for it."""

from typing import Any

import numpy as np
import pytest
import warp as wp

from concent_warp.simulate.parallel import limit_simulations
from concent_warp.simulate.warp_modules import launched_modules, load_modules

FACTORS = (3.0, 5.0, 7.0)


def scaling(factor: float):
    """Return a kernel in a module of its own."""

    @wp.kernel(module="unique", enable_backward=False)
    def scale(values: Any):
        i = wp.tid()
        values[i] = factor * values[i]

    return scale


@wp.kernel(module="unique", enable_backward=False)
def cast(values: Any, out: Any):
    i = wp.tid()
    out[i] = float(values[i])


@pytest.fixture
def launches():
    """Launches in a loop, a branch and of a generic kernel with two types, and the numbers that they change."""
    values = wp.full(4, 1.0, dtype=float, device="cpu")
    small, zero = wp.zeros(4, dtype=wp.int32, device="cpu"), wp.zeros(1, dtype=int, device="cpu")
    kernels = [scaling(factor) for factor in FACTORS]

    def launch():
        wp.launch(kernels[0], dim=4, inputs=[values], device="cpu")
        wp.capture_while(zero, wp.launch, kernel=kernels[1], dim=4, inputs=[values], device="cpu")
        wp.capture_if(zero, on_false=lambda: wp.launch(kernels[2], dim=4, inputs=[values], device="cpu"))
        for source in (values, small):
            wp.launch(cast, dim=4, inputs=[source], outputs=[values], device="cpu")

    return launch, values, kernels


def test_nothing_is_launched_and_no_module_is_missed(launches):
    launch, values, kernels = launches
    found = launched_modules(launch)
    np.testing.assert_array_equal(values.numpy(), 1)
    assert [module for module, _, _ in found[:3]] == [kernel.module for kernel in kernels]
    assert len(found) == 4
    assert all(not module.execs for module, _, _ in found[:3])


def test_modules_are_loaded_once_with_all_types(launches, monkeypatch):
    launch, values, kernels = launches
    with limit_simulations(2):
        load_modules(launch)
    assert all(kernel.module.execs for kernel in kernels)
    compiled = []
    monkeypatch.setattr(wp.Module, "_compile", lambda *_, **__: compiled.append(1))
    launch()
    assert not compiled
    np.testing.assert_array_equal(values.numpy(), 0)


def test_a_kernel_that_does_not_compile_says_so():
    @wp.kernel(module="unique", enable_backward=False)
    def broken(values: Any):
        values[wp.tid()] = undefined_name  # noqa: F821 # pyright: ignore[reportUndefinedVariable]

    values = wp.ones(1, dtype=float, device="cpu")

    def launch():
        wp.launch(broken, dim=1, inputs=[values], device="cpu")
        wp.launch(scaling(2.0), dim=1, inputs=[values], device="cpu")

    with limit_simulations(2), pytest.raises(Exception, match="undefined_name"):
        load_modules(launch)


def test_what_fails_while_collecting_is_left_to_the_launches():
    def launch():
        raise NotImplementedError("no such thing")

    load_modules(launch)
    with pytest.raises(NotImplementedError):
        launched_modules(launch)
    assert wp.Module.load.__name__ == "load"
