"""What the package imports is what `pyproject.toml` declares."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

INDIRECT = {"onnxscript": "torch.onnx"}
"""Declared packages that another one imports for a function that is used, with the name of that function's module."""
OPTIONAL = ("logs", "features", "sam2", "florence2")
"""Extras that the package imports where they are needed, with a sentence that names them where they are missing."""


def normalised(name: str) -> str:
    """Return the name of a distribution as indices compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.fixture(scope="module")
def declared(root: Path) -> set[str]:
    """Return the distributions that an installation brings, with those of the extras."""
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    lines = [line for extra in OPTIONAL for line in project["optional-dependencies"][extra]]
    return {normalised(re.split(r"[\[<>=~! ]", line)[0]) for line in (*project["dependencies"], *lines)}


@pytest.fixture(scope="module")
def imported(rooms: dict[str, Path]) -> set[str]:
    """Return the distributions that modules of the package import, wherever in the file."""
    names: set[str] = set()
    for folder in rooms.values():
        for path in folder.rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    names |= {alias.name.partition(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                    names.add(node.module.partition(".")[0])
    known = packages_distributions()
    names -= {*sys.stdlib_module_names, "concent_warp"}
    return {normalised(known[name][0]) for name in names}


def test_everything_imported_is_declared(declared, imported):
    assert imported - declared == set()


def test_everything_declared_is_imported(declared, imported):
    assert declared - imported == set(INDIRECT)


@pytest.mark.parametrize(("distribution", "module"), INDIRECT.items())
def test_indirect_dependency_serves_a_module_that_is_used(rooms, distribution, module):
    texts = [path.read_text() for folder in rooms.values() for path in folder.rglob("*.py")]
    assert any(module in text for text in texts), distribution
