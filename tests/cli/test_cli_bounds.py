"""Numbers that make no sense are refused by every command, in one sentence that names the option as it is typed."""

import re
import warnings
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import tyro

from concent_warp.checks import _bounds_of, check_settings, named_as
from concent_warp.cli import main
from concent_warp.cli.entry import COMMANDS, parser_sentence
from concent_warp.cli.option_names import option_namer, options_of
from concent_warp.errors import ConcentError
from concent_warp.fit.fit_geometry import FitCfg
from concent_warp.fit.geometry.evolution import EvolutionCfg
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.train.cfg import TrainCfg

BAD = {"FLOAT": (-1.0, float("nan"), float("inf"), 1e300), "INT": (-1, 10**300)}
"""Values tried for each kind of number; of the others tyro itself refuses those that are no integers."""
COORDINATE = "a coordinate in a scene, or an angle, which has either sign"
NEGATIVE = {
    "--jobs": "-1 stands for one process a CPU",
    "--explain.jobs": "-1 stands for one process a CPU",
    "--eye": COORDINATE,
    "--lights.ground": COORDINATE,
    "--start": COORDINATE,
    **{f"--{prefix}sensors.{name}-bias": COORDINATE
       for prefix in ("", "environment.observation.", "stress.", "evaluate.")
       for name in ("position", "orientation")},
    "--limits.workspace": COORDINATE,
    "--environment.reset.before": "after the stage's start, not before it",
    "--reality.expert.grip-height": COORDINATE,
    "--reality.sensing.camera-position": COORDINATE,
    "--reality.sensing.camera-target": COORDINATE,
    "--environment.reward.engineered.hole": COORDINATE,
    "--environment.reward.engineered.seat": COORDINATE,
    **{f"--{prefix}.{name}": COORDINATE
       for prefix in ("reality.task", "shapes", "evaluate.shapes")
       for name in ("block-position", "block-yaw", "box-position", "box-yaw")},
}  # fmt: skip
"""Options of which -1 is accepted, and why."""


def module_of(command: str) -> Any:
    return import_module(f"concent_warp.cli.commands.{command.replace('-', '_')}")


@cache
def numeric_options(command: str) -> dict[str, str]:
    """Return "INT" or "FLOAT" by option, as the parser of a command has them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        parser = tyro.extras.get_parser(module_of(command).Arguments, config=(tyro.conf.HelptextFromCommentsOff,))
    found = {}
    for action in parser._actions:
        kinds = [kind for kind in ("FLOAT", "INT") if kind in str(action.metavar)]
        if kinds:
            found[next(one for one in action.option_strings if one.startswith("--"))] = kinds[0]
    return found


def default(command: str) -> Any:
    """Return the arguments of a command with a path for each that has no default."""
    kind = module_of(command).Arguments
    needed = (f for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING)
    return kind(**{field.name: Path("input") for field in needed})


def changed(settings: Any, name: str, value: object) -> Any:
    """Return settings in which the number of a dotted name, or each of several, is another one."""
    first, _, rest = name.partition(".")
    before = getattr(settings, first)
    if rest:
        return replace(settings, **{first: changed(before, rest, value)})
    if isinstance(before, tuple):
        value = (value,) * max(len(before), 1)
    elif isinstance(before, Mapping):
        value = {"body": value}
    return replace(settings, **{first: value})


@pytest.mark.parametrize("command", COMMANDS)
def test_every_number_has_bounds(command):
    kind = module_of(command).Arguments
    settings, names = default(command), {option: name for name, option in options_of(kind)}
    with named_as(option_namer(kind)):
        check_settings(settings)
        for option, number in numeric_options(command).items():
            for value in BAD[number]:
                said = refusal(settings, names[option], value)
                if value == -1 and option in NEGATIVE:
                    assert said == ""
                else:
                    assert re.fullmatch(f"{option} is (not a number|out of bounds); expected [^\n;]*\\.", said), option


def refusal(settings: Any, name: str, value: object) -> str:
    """Return why a number is refused, empty where it is not."""
    try:
        check_settings(changed(settings, name, value))
    except ConcentError as error:
        return str(error)
    return ""


def test_there_are_hundreds_of_numbers_and_all_exceptions_are_options():
    options = {option for command in COMMANDS for option in numeric_options(command)}
    assert len(options) > 250
    assert set(NEGATIVE) <= options


def ranges(settings: Any, prefix: str = "") -> list[str]:
    """Return the dotted names of what is a smallest and a largest value."""
    found = []
    for name, bounds in _bounds_of(type(settings)).items():
        value = getattr(settings, name)
        if is_dataclass(value):
            found += ranges(value, f"{prefix}{name}.")
        elif bounds is not None and bounds.ascending:
            found.append(f"{prefix}{name}")
    return found


def test_reversed_ranges_are_refused():
    found = {(command, name) for command in COMMANDS for name in ranges(default(command))}
    assert len(found) > 12
    for command, name in found:
        owner = default(command)
        for part in name.split(".")[:-1]:
            owner = getattr(owner, part)
        last = name.split(".")[-1]
        low, high = getattr(owner, last)[0], _bounds_of(type(owner))[last].high
        reversed_range = (min(high, 1.0) if low < 1 else low + 1, min(high, 1.0) / 2)
        with pytest.raises(ConcentError, match="is out of bounds; expected a smallest and a largest value"):
            check_settings(replace(owner, **{last: reversed_range}))


LINES = [
    ("fit demo.h5 --fit.generations -1", "--fit.generations is out of bounds; expected at least 0"),
    ("fit demo.h5 --fit.window 1e-9", "--fit.window is out of bounds; expected at least 0.001"),
    ("fit demo.h5 --fit.held-out 1", "--fit.held-out is out of bounds; expected at least 0 and below 1"),
    ("fit demo.h5 --fit.evolution.elite-share 1.5", "--fit.evolution.elite-share is out of bounds"),
    ("fit demo.h5 --count 0", "--count is out of bounds; expected at least 1"),
    ("fit demo.h5 --radius nan", "--radius is not a number"),
    ("fit demo.h5 --counts block 0", "--counts is out of bounds"),
    ("geometry scene.xml -o model.toml --scale 0", "--scale is out of bounds; expected above 0"),
    ("demo --reality.task.block-size inf", "--reality.task.block-size is out of bounds"),
    ("demo --reality.task.timestep 1e-9", "--reality.task.timestep is out of bounds"),
    ("record --reality.expert.offset 0.02 0.01", "--reality.expert.offset is out of bounds; expected a smallest and"),
    ("record --reality.sensing.image-size 0 128", "--reality.sensing.image-size is out of bounds"),
    ("diagnose demo.h5 --window 0", "--window is out of bounds; expected at least 0.001"),
    ("diagnose demo.h5 --jobs -2", "--jobs is out of bounds; expected at least -1"),
    (
        "diagnose demo.h5 --jobs 0",
        "--jobs is out of bounds; expected at least -1 and at most 4096, but not 0",
    ),
    ("locate demo.h5 --window -1", "--window is out of bounds; expected at least 0.001"),
    ("add joint_friction --model m.toml --fit demo.h5 --window nan -o x.toml", "--window is not a number"),
    ("compare demo.h5 --places -1", "--places is out of bounds"),
    ("events demo.h5 --model m.toml --staging.min-touch-share 1.5", "--staging.min-touch-share is out of bounds"),
    ("train demo.h5 --model m.toml --worlds 1000000000", "--worlds is out of bounds; expected at least 1"),
    ("train demo.h5 --model m.toml --environment.episode 0", "--environment.episode is out of bounds"),
    ("train demo.h5 --model m.toml --target 1.01", "--target is out of bounds"),
    ("train demo.h5 --model m.toml --seed -1", "--seed is out of bounds; expected 0 to 4294967295"),
    ("train demo.h5 --model m.toml --environment.randomisation.mass 2 1", "--environment.randomisation.mass is out of"),
    ("evaluate --pretrained --episodes 0", "--episodes is out of bounds; expected at least 1"),
    ("evaluate --pretrained --action-scale 1.5", "--action-scale is out of bounds; expected above 0 and at most 1"),
    ("play --pretrained --port -1", "--port is out of bounds; expected at least 0 and at most 65535"),
    ("play --pretrained --port 65536", "--port is out of bounds"),
    ("play --pretrained --speed 9", "--speed is out of bounds; expected at least 0.1 and at most 4, found 9"),
    ("render --pretrained --size 0", "--size is out of bounds"),
    ("render --pretrained --lights.elevation 80 35", "--lights.elevation is out of bounds; expected a smallest and"),
    ("splat-fit images --fit.degree 4", "--fit.degree is out of bounds; expected at least 0 and at most 3"),
    ("render-train demo.h5 --flow.ema 1", "--flow.ema is out of bounds; expected at least 0 and below 1"),
    ("fit demo.h5 --fit.generations many", "error parsing --fit.generations: invalid literal for int()"),
    ("train demo.h5 --model m.toml --iterations x", "--iterations is not right; expected INT, found 'x'; see concent"),
    ("fit demo.h5 --fit.generatons 3", "unrecognized options: --fit.generatons, 3; perhaps --fit.generations"),
    ("fit", "missing from concent fit: PATH; see concent fit --help."),
    ("train", "missing from concent train: PATH, --model PATH; see concent train --help."),
    ("fit demo.h5 --engine drake", "invalid choice 'drake' for argument '--engine'."),
]


@pytest.mark.parametrize(("line", "said"), LINES, ids=[line for line, _ in LINES])
def test_nothing_is_begun_with_numbers_out_of_bounds(line, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module_of(line.split()[0]), "run", lambda _: pytest.fail("was begun"))
    assert main(line.split()) == 2
    sentences = [one for one in capsys.readouterr().err.splitlines() if "loading ..." not in one]
    assert len(sentences) == 1
    assert sentences[0].startswith(f"concent {line.split()[0]}: {said}")
    assert not list(tmp_path.iterdir())


def test_box_of_a_parser_without_content_is_a_sentence_all_the_same():
    assert parser_sentence("") == "the options are not right"


def test_option_of_a_part_of_the_settings_is_found_where_there_is_one():
    option, kinds = option_namer(module_of("demo").Arguments), (FitCfg, EvolutionCfg, ContactGeometryCfg, TrainCfg)
    found = [option("seed", kind) for kind in kinds]
    assert found == ["--fit.seed", "seed", "--seed", "seed"]
    assert option("momentum", EvolutionCfg) == "--fit.evolution.momentum"
