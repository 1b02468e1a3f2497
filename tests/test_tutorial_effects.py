"""The tutorial on a recording that hides an effect, from its first command to its last, with the figures it shows."""

from __future__ import annotations

import json
import re
import runpy
import shlex
import shutil
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

from concent_warp.cli import main
from concent_warp.model import Model
from concent_warp.recording.load import load_recording

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "tutorial_effects.md").read_text()
STEP = re.compile(r"```console\n([^`]*)```\n+```text\n([^`]*)```")
NUMBER = re.compile(r"\d+(?:\.\d+)?")
WORDS = re.compile(r"\w")


def steps() -> list[tuple[str, str]]:
    """Return each command of the page that is followed by what it prints."""
    return [(command.strip(), shown) for command, shown in STEP.findall(PAGE)]


def numbers(line: str) -> list[float]:
    """Return the numbers in a line."""
    return [float(text) for text in NUMBER.findall(line)]


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return what each command of the page prints, one after the other in one folder."""
    folder = tmp_path_factory.mktemp("tutorial")
    for name in ("demo.h5", "scene.xml"):
        shutil.copy(ROOT / "examples" / "hidden_effect" / name, folder / name)
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for command, _ in steps():
            arguments = shlex.split(command)
            if arguments[1] == "diagnose":
                arguments += ["--jobs", "1"]
            with redirect_stdout(StringIO()) as out:
                assert main(arguments[1:]) == 0, command
            found[command] = out.getvalue()
    found["folder"] = str(folder)
    return found


def test_the_page_goes_from_comparison_to_comparison():
    called = [shlex.split(command)[1] for command, _ in steps()]
    assert called[:2] == ["compare", "diagnose"]
    assert called[-1] == "compare"
    assert "add" in called


@pytest.mark.parametrize(("command", "shown"), steps(), ids=[command for command, _ in steps()])
def test_every_line_shown_is_printed_with_the_same_figures(command, shown, printed):
    lines = printed[command].splitlines()
    for line in filter(WORDS.search, shown.splitlines()):
        words = NUMBER.sub("#", " ".join(line.split()))
        like = [other for other in lines if NUMBER.sub("#", " ".join(other.split())) == words]
        assert like, f"{line!r} is not printed:\n" + "\n".join(lines)
        gaps = [np.abs(np.subtract(numbers(other), numbers(line))) for other in like]
        allowed = 0.02 + 0.1 * np.abs(numbers(line))
        assert any((gap <= allowed).all() for gap in gaps), f"{line!r} shows other figures:\n" + "\n".join(like)


def test_what_was_hidden_is_named_and_its_value_found(printed):
    sys.path.insert(0, str(ROOT / "examples" / "hidden_effect"))
    try:
        from make import FRICTION  # pyright: ignore[reportMissingImports]
    finally:
        sys.path.pop(0)
    (added,) = Model.load(Path(printed["folder"]) / "with_friction.toml").effects
    assert added.effect.name == "joint_friction"
    ((low, high),) = added.intervals
    assert low <= FRICTION <= high
    assert abs(added.values[0] - FRICTION) < 0.03 * FRICTION
    assert any("Missing: joint_friction" in text for text in printed.values())


def test_the_front_page_shows_the_same_figures():
    front = (ROOT / "README.md").read_text()
    (found,) = re.findall(r"Missing: joint_friction \(torque\[hinge\] (.*? N m)\)", PAGE)
    assert f"# joint friction, {found}\n" in front
    (before,) = re.findall(r"hinge_position .*│ +([\d.]+) x │\n├.*\n│ marker_position .* 1.4 x", PAGE)
    assert f"# the encoder is off by {before} x its noise\n" in front
    (change, after) = re.findall(r"hinge_position .* (-\d+ %) .*│ +([\d.]+) x │\n", PAGE)[0]
    assert f"# {after} x noise, {change}\n" in front
    assert "](docs/images/hidden_effect.png)" in front


@pytest.fixture
def run(monkeypatch) -> Callable[..., None]:
    """Return a function that runs a script with arguments, in this process."""

    def run(script: Path, *arguments: object) -> None:
        monkeypatch.setattr(sys, "argv", [str(script), *map(str, arguments)])
        monkeypatch.syspath_prepend(script.parent)
        runpy.run_path(str(script), run_name="__main__")

    return run


def test_the_recording_is_what_its_script_makes(run, tmp_path):
    script = ROOT / "examples" / "hidden_effect" / "make.py"
    run(script, tmp_path)
    made, kept = load_recording(tmp_path / "demo.h5"), load_recording(script.parent / "demo.h5")
    assert made.scene == kept.scene
    (one,), (other,) = made.demonstrations, kept.demonstrations
    assert one.measured.keys() == other.measured.keys()
    for name, channel in one.measured.items():
        np.testing.assert_allclose(channel.value, other.measured[name].value, atol=1e-6)
    assert (tmp_path / "scene.xml").read_text() == (script.parent / "scene.xml").read_text()
    assert (script.parent / "demo.h5").stat().st_size < 300_000


def test_the_picture_is_drawn_from_a_diagnosis(run, printed, tmp_path):
    folder = Path(printed["folder"])
    effect = {"name": "joint_friction", "step": 0, "accepted": True, "gain": {"value": 0.9, "interval": [0.8, 0.95]}}
    (tmp_path / "found.json").write_text(json.dumps({"effects": [effect]}))
    script = ROOT / "examples" / "hidden_effect" / "picture.py"
    models = [folder / "scene.xml", folder / "with_friction.toml"]
    arguments = [tmp_path / "found.json", folder / "demo.h5", *models, tmp_path / "p.png"]
    run(script, *arguments)
    assert (tmp_path / "p.png").stat().st_size > 10_000
