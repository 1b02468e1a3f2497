"""What lands in site-packages: one package, all of its modules, and the files that it reads."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest


def run(*command: str | Path, cwd: Path | None = None, env: dict[str, str] | None = None) -> str:
    """Return what a command prints; fails with what it says."""
    done = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(root: Path, rooms: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a wheel built from a copy of the sources."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(root / name, source)
    for folder in rooms.values():
        shutil.copytree(folder, source / folder.name, ignore=shutil.ignore_patterns("__pycache__"))
    run(sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", out, source)
    (built,) = out.glob("*.whl")
    return built


def test_wheel_has_every_file_of_the_four_rooms_under_one_name(wheel, rooms):
    expected = set()
    for package, folder in rooms.items():
        for path in folder.rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                expected.add("/".join([*package.split("."), *path.relative_to(folder).parts]))
    found = {name for name in ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert found == expected
    assert {
        "concent_warp/kernels/chamfer/distance.py",
        "concent_warp/train/__init__.py",
        "concent_warp/render/__init__.py",
    } < found
    assert "concent_warp/report/page/page.html" in found


def test_wheel_works_without_the_sources(wheel, tmp_path):
    ZipFile(wheel).extractall(tmp_path)
    code = (
        "import concent_warp, concent_warp.train, concent_warp.kernels as k; print(concent_warp.__file__, k.__file__)"
    )
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    for path in run(sys.executable, "-c", code, env=environment, cwd=tmp_path).split():
        assert Path(path).is_relative_to(tmp_path)
    assert "concent demo" in run(sys.executable, "-m", "concent_warp", "--help", env=environment, cwd=tmp_path)


def test_wheel_brings_the_command_the_licence_and_the_version(wheel, root):
    import concent_warp

    archive = ZipFile(wheel)
    (info,) = {name.split("/")[0] for name in archive.namelist() if ".dist-info/" in name}
    assert info == f"concent_warp-{concent_warp.__version__}.dist-info"
    assert "concent = concent_warp.cli:main" in archive.read(f"{info}/entry_points.txt").decode()
    assert archive.read(f"{info}/licenses/LICENSE") == (root / "LICENSE").read_bytes()


def test_version_is_the_same_wherever_it_is_named(root):
    import concent_warp

    assert f"\nversion: {concent_warp.__version__}\n" in (root / "CITATION.cff").read_text()
    assert f"\n## [{concent_warp.__version__}] - " in (root / "CHANGELOG.md").read_text()
