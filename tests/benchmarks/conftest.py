"""Benchmarks are scripts beside one another, and import each other by name."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from tests.fit.conftest import drop, swollen

__all__ = ["drop", "script", "swollen"]


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch, root: Path) -> Callable[[str], ModuleType]:
    """Return what imports a benchmark by its name."""
    monkeypatch.syspath_prepend(root / "benchmarks")
    return importlib.import_module
