"""What the documentation shows can be done as it is written there."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest
import tyro

from concent_warp.cli.entry import COMMANDS
from concent_warp.reality.expert.plan import ExpertCfg
from concent_warp.reality.record import RealityCfg, record
from concent_warp.recording.formats.hdf5 import write_hdf5

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
GIVEN = {
    "events.md": """
from pathlib import Path
from concent_warp.model import Model
from concent_warp.recording.load import load_recording
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.scene.scene import Scene
from concent_warp.simulate.select import make_engine
recording = load_recording("demo.h5")
scene = Scene(recording.scene)
model = Model(scene, ContactGeometryCfg(count=96).build(scene))
engine = make_engine("mujoco", model)
""",
    "diagnose.md": f"""
import shutil
from pathlib import Path
Path("demo.h5").unlink()
shutil.copy({str(ROOT / "examples" / "hidden_effect" / "demo.h5")!r}, "demo.h5")
""",
}
"""What a page takes as given."""
LONG = ("distil.md", "explain.md", "flow_policy.md", "index.md")
"""Pages whose Python takes long; that of index.md does what steps/diagnose.py and write_report.py in examples/ do."""


def blocks(page: Path, *languages: str) -> list[str]:
    """Return the blocks of some languages in a page."""
    return [text for language, text in BLOCK.findall(page.read_text()) if language in languages]


def commands() -> list[str]:
    """Return every line of the pages that calls the command, with what a backslash carries over to the next line."""
    texts = [text.replace("\\\n", " ") for page in PAGES for text in blocks(page, "console")]
    lines = [line.strip() for text in texts for line in text.splitlines()]
    lines += [code for page in PAGES for code in re.findall(r"`(concent [^`]+)`", page.read_text())]
    return sorted({line for line in lines if line.startswith("concent ")})


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of Reality, of a fast demonstration: how long it is does not matter to the pages."""
    path = tmp_path_factory.mktemp("docs") / "demo.h5"
    write_hdf5(record(RealityCfg(expert=ExpertCfg(speed=3.0)), [0])[0], path)
    return path


@pytest.fixture(scope="module")
def film() -> Callable:
    """Return what records as Reality does, but demonstrates fast, and what several pages record only once."""

    @cache
    def recorded(cfg: RealityCfg, seeds: tuple[int, ...]):
        return record(replace(cfg, expert=replace(cfg.expert, speed=3.0)), list(seeds))

    return lambda cfg, seeds: recorded(cfg, tuple(seeds))


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.slow if page.name in LONG else (), id=page.name)
        for page in PAGES
        if blocks(page, "python")
    ],
)
def test_python_of_a_page_runs_from_top_to_bottom(page, recorded, film, tmp_path, monkeypatch):
    (tmp_path / "demo.h5").symlink_to(recorded)
    (tmp_path / "runs" / "demo").mkdir(parents=True)
    (tmp_path / "runs" / "demo" / "demo.h5").symlink_to(recorded)
    (tmp_path / "page.py").write_text("\n".join([GIVEN.get(page.name, ""), *blocks(page, "python")]))
    if page.name != "README.md":  # which is run as a user runs it
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr("concent_warp.reality.record.record", film)
        runpy.run_path("page.py")
        return
    environment = {name: value for name, value in os.environ.items() if name != "LOKY_MAX_CPU_COUNT"}
    done = subprocess.run(
        [sys.executable, "page.py"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("line", commands())
def test_command_in_the_pages_is_understood(line):
    _, command, *arguments = shlex.split(line, comments=True)
    if command.startswith("--"):
        assert command in ("--help", "--version")
        return
    assert command in COMMANDS
    if arguments and not {"--help", "--help-all"} & set(arguments):
        module = import_module(f"concent_warp.cli.commands.{command.replace('-', '_')}")
        tyro.cli(module.Arguments, args=arguments, config=(tyro.conf.HelptextFromCommentsOff,))


def test_the_page_of_commands_has_every_command():
    text = (ROOT / "docs" / "commands.md").read_text()
    assert all(f"`concent {command}`" in text for command in COMMANDS)


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text().split()) <= 700
    assert len((ROOT / "docs" / "train.md").read_text().split()) <= 1550


@pytest.mark.parametrize("page", [*PAGES, *sorted((ROOT / "docs" / "benchmarks").glob("*.md"))], ids=lambda p: p.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
        assert "://" in target or (page.parent / target).exists(), target


def test_code_named_in_the_method_exists():
    text = (ROOT / "docs" / "method.md").read_text()
    rooms = [path.name for path in (ROOT / "concent_warp").iterdir() if path.is_dir()] + ["kernels"]
    names = re.findall(rf"`((?:{'|'.join(rooms)})(?:\.\w+)+)`", text)
    assert len(names) > 20
    for name in names:
        assert resolved(f"concent_warp.{name}"), name


def resolved(name: str) -> object:
    """Return the module, class, function or method of a dotted name."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found: object = import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            found = getattr(found, part)
        return found
    raise ModuleNotFoundError(name)


def test_house_shows_the_layers_that_are_checked():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    layers = next(contract["layers"] for contract in settings["contracts"] if contract["type"] == "layers")
    (shown,) = re.findall(r"```text\n(cli\n.*?)```", (ROOT / "docs" / "house.md").read_text(), re.DOTALL)
    assert shown.split("\n")[:-1] == [layer for layer in layers if layer != "__main__"]


def test_house_lists_every_room_and_sub_room():
    table = (ROOT / "docs" / "house.md").read_text().split("## Rooms")[1].split("## Who may import whom")[0]
    listed: dict[str, set[str]] = {}
    for row in table.splitlines():
        cells = row.split("|")
        if len(cells) == 5:
            listed |= {
                name: set(re.findall(r"`(\w+)`", cells[3])) for name in re.findall(r"`(\w+)(?:\.py)?`", cells[1])
            }
    packages = {path.name: path for path in (ROOT / "concent_warp").iterdir() if (path / "__init__.py").is_file()}
    packages |= {name: ROOT / name for name in ("kernels", "train", "render")}
    modules = {path.stem for path in (ROOT / "concent_warp").glob("*.py")} - {"__init__", "__main__"}
    assert set(listed) == {*packages, *modules}
    for name, folder in packages.items():
        assert listed[name] == {path.name for path in folder.iterdir() if (path / "__init__.py").is_file()}, name
