"""The import rules in pyproject.toml hold, and a breach of any of them is noticed."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SETTINGS = Path(__file__).parents[1] / "pyproject.toml"


@pytest.fixture
def tree(tmp_path: Path, rooms: dict[str, Path]) -> Path:
    """Return a folder with a copy of the package as it is installed."""
    for package, folder in rooms.items():
        place = tmp_path.joinpath(*package.split("."))
        shutil.copytree(folder, place, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
    return tmp_path


def broken(tree: Path) -> str:
    """Return what import-linter says of the package in a folder; empty if the rules hold."""
    command = [Path(sys.executable).with_name("lint-imports"), "--config", SETTINGS, "--no-cache"]
    done = subprocess.run(command, cwd=tree, capture_output=True, text=True, timeout=60, check=False)
    return "" if done.returncode == 0 else done.stdout + done.stderr


def planted(tree: Path, module: str, statement: str) -> str:
    """Return what import-linter says after a statement has been added to a module of the package."""
    path = tree.joinpath("concent_warp", *module.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    assert path.is_file()
    path.write_text(f"{path.read_text()}\n{statement}\n")
    said = broken(tree)
    assert "BROKEN" in said
    return said


def test_package_keeps_the_rules(tree):
    assert broken(tree) == ""


@pytest.mark.parametrize(
    ("module", "imported"),
    [
        ("kernels.chamfer.distance", "errors"),
        ("kernels.chamfer.distance", "model"),
        ("errors", "kernels"),
        ("scene.scene", "model"),
        ("recording.formats.hdf5", "simulate.replay"),
        ("model", "simulate.engine"),
        ("simulate.replay", "events.extract"),
        ("fit.fit_geometry", "report.report"),
        ("report.report", "ground"),
        ("ground", "cli.commands.demo"),
        ("model", "train"),
        ("train", "render"),
        ("render", "train"),
        ("fit.fit_geometry", "reality.world"),
        ("comparison.compare", "reality.record"),
        ("train", "reality.record"),
        ("reality.world", "model"),
        ("reality.record", "simulate.replay"),
    ],
)
def test_breach_is_noticed(tree, module, imported):
    said = planted(tree, module, f"import concent_warp.{imported}")
    assert f"concent_warp.{module} -> concent_warp.{imported}" in said


@pytest.mark.parametrize(
    "statement",
    [
        "def later():\n    from concent_warp.reality.record import record",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from concent_warp.reality.record import RealityCfg",
        "from ..reality import record",
    ],
    ids=["in a function", "for types", "relative"],
)
def test_breach_is_noticed_wherever_it_stands(tree, statement):
    assert "concent_warp.fit.fit_geometry -> concent_warp.reality" in planted(tree, "fit.fit_geometry", statement)


def test_module_without_a_place_is_noticed(tree):
    (tree / "concent_warp" / "attic.py").touch()
    assert "attic" in broken(tree)
