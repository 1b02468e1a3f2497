"""What an import costs, and that every module can be imported."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

import concent_warp

HEAVY = {
    *("torch", "warp", "mujoco_warp", "newton", "rsl_rl"),
    *("trimesh", "kornia", "cv2", "matplotlib"),
}
"""Packages that are slow to import or that a host may lack."""
ABOUT_WARP = (
    *("concent_warp.kernels", "concent_warp.train", "concent_warp.render", "concent_warp.simulate.warp_"),
    *("concent_warp.deploy.evaluate", "concent_warp.deploy.play", "concent_warp.deploy.reality_world"),
    *("concent_warp.deploy.distil", "concent_warp.deploy.simulated_images", "concent_warp.deploy.reality_images"),
    *("concent_warp.deploy.explain.", "concent_warp.deploy.improve.", "concent_warp.deploy.trial_environment"),
    *("concent_warp.deploy.handover", "concent_warp.deploy.record_trials"),
)
"""Modules that are all about such a package: whoever needs them imports them where needed."""
ANSWER = 1.0
"""Within which a user expects an answer [s]."""


@pytest.fixture(scope="module")
def modules(rooms: dict[str, Path]) -> list[str]:
    """Return the names of all modules, in order."""
    found = []
    for package, folder in rooms.items():
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            found.append(".".join([package, *(part for part in parts if part != "__init__")]))
    return found


def python(*arguments: str) -> str:
    """Return what a new interpreter prints; fails with what it says on standard error."""
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def seconds(*arguments: str) -> float:
    """Return the least of five run times [s] of a new interpreter."""
    times = []
    for _ in range(5):
        start = time.perf_counter()
        python(*arguments)
        times.append(time.perf_counter() - start)
    return min(times)


def loaded_by(*names: str) -> set[str]:
    """Return the top-level packages that an interpreter holds after importing modules."""
    lines = [f"import_module({name!r})" for name in names]  # `concent import` is in a module of that name
    code = ["import sys", "from importlib import import_module", *lines, "print(*sys.modules)"]
    return set(python("-c", "\n".join(code)).split())


def test_api_reference_lists_every_public_name_once(root):
    pages = [path.read_text() for path in (root / "docs" / "api").glob("*.md")]
    listed = re.findall(r"^::: concent_warp\.(\w+)$", "\n".join(pages), re.MULTILINE)
    assert sorted(listed) == sorted(name for name in concent_warp.__all__ if not name.startswith("_"))
    index = (root / "docs" / "api" / "index.md").read_text()
    assert [name for name in listed if f"`{name}`" not in index] == []


def test_package_imports_within_a_second_and_loads_nothing_heavy():
    assert seconds("-c", "import concent_warp") < ANSWER
    assert not loaded_by("concent_warp") & (HEAVY | {"mujoco", "numpy"})


@pytest.mark.parametrize("arguments", [["--help"], ["--version"]])
def test_command_answers_within_a_second(arguments):
    assert seconds("-m", "concent_warp", *arguments) < ANSWER


def test_library_loads_heavy_packages_only_where_they_are_used(modules):
    light = [name for name in modules if not name.startswith(ABOUT_WARP) and not name.endswith("__main__")]
    assert len(light) > 60
    assert not loaded_by(*light) & HEAVY


def test_every_module_can_be_imported(modules):
    assert {"concent_warp.kernels.chamfer.distance", "concent_warp.train", "concent_warp.render"} < set(modules)
    assert set(modules) <= loaded_by(*modules)
