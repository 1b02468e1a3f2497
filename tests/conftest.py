"""Where the sources are, for tests of the package as a whole."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def root() -> Path:
    """Return the folder of the repository."""
    return Path(__file__).parents[1]


@pytest.fixture(scope="session")
def rooms(root: Path) -> dict[str, Path]:
    """Return the folder of each import package that does not lie within another's."""
    project = tomllib.loads((root / "pyproject.toml").read_text())
    return {package: root / folder for package, folder in project["tool"]["setuptools"]["package-dir"].items()}
