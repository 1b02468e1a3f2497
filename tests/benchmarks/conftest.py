"""Benchmarks are modules of the package `benchmarks`; each is imported by the test that needs it."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from types import ModuleType

import pytest

from tests.fit.conftest import drop, swollen

__all__ = ["drop", "script", "swollen"]


@pytest.fixture
def script() -> Callable[[str], ModuleType]:
    """Return what imports a benchmark by its name."""
    return importlib.import_module
