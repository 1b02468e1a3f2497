"""Senseless values of every numeric option of every command, and options that are wrong in other ways."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from importlib import import_module
from typing import Any

from benchmarks.bad_input.case import Case
from concent_warp.cli.entry import COMMANDS

NEEDED = {
    "geometry": "scene.xml -o out.toml",
    "fit": "recording.h5 -o out",
    "replay": "recording.h5 --model model.toml -o out.npz",
    "events": "recording.h5 --model model.toml -o out",
    "compare": "recording.h5",
    "diagnose": "recording.h5 -o out",
    "suggest": "recording.h5 --diagnosis found.json -o out.h5",
    "locate": "recording.h5",
    "add": "joint_friction --model model.toml --fit recording.h5 -o out.toml",
    "train": "recording.h5 --model model.toml --device cpu -o out",
    "distil": "shape_sorter --device cpu -o out",
    "train-flow": "dataset --device cpu -o out",
    "evaluate": "--pretrained --device cpu",
    "explain": "shape_sorter recording.h5 -o out",
    "improve": "recording.h5 --policy shape_sorter --trials trials -o out",
    "play": "--pretrained",
    "export": "--pretrained -o out.onnx",
    "splat-fit": "images -o out",
    "render-train": "recording.h5 -o out --device cpu",
    "render": "--recording recording.h5 -o out",
    "demo": "-o out",
    "record": "-o out.h5",
    "import": "log --model scene.xml --map map.toml -o out.h5",
    "calibrate": "recording.h5 -o out.h5",
    "track": "recording.h5 -o out.h5",
}
"""What each command needs besides the option that is wrong."""
SIGNED = (
    "jobs", "--eye", "--lights.ground", "--reality.expert.grip-height", "--reality.sensing.camera-position",
    "--reality.sensing.camera-target", "--environment.reward.engineered.hole", "--environment.reward.engineered.seat",
    "-position", "-yaw", "-bias", "--start", "--limits.workspace",
)  # fmt: skip
"""Ends of options that may be -1."""
SENSELESS = {"FLOAT": ("nan", "-1", "inf", "1e300"), "INT": ("-1", "9" * 300, "1.5", "nan", "-1")}
"""Values that are tried in turn, by the kind of the option."""
WRONG = {
    "compare": (
        "--engine drake", "--phases some", "--places many", "--demonstrations demo_9", "--nothing", "--model",
    ),
    "fit": (
        "--method magic", "--fit.evolution.noise pink", "--fit.generatons 3", "--model", "--counts block",
        "--fit.window 1e-9", "--counts brick 5", "--demonstrations demo_9",
    ),
    "diagnose": (
        "--effects magic", "--window 0", "--jobs 0", "--additions 0",
    ),
    "suggest": (
        "--method magic", "--duration 0", "--evaluations 0", "--population 1", "--max-interval 0", "--jobs 0",
        "--diagnosis gone.json", "--diagnosis scene.xml", "--limits.workspace 1 2 3", "-o out.csv", "--model gone.xml",
    ),
    "locate": (
        "--window 0", "--png out.what", "--html scene.xml",
    ),
    "add": (
        "--target knee", "--set values=1", "--set magic", "--window 0",
    ),
    "geometry": (
        "--objects brick", "--add block gone.stl", "--scale 0", "--thin fat", "--count 0", "--export scene.xml",
    ),
    "replay": (
        "--demonstrations demo_9", "--engine", "-o scene.xml",
    ),
    "events": (
        "--demonstrations demo_9", "--staging.target never", "-o scene.xml",
    ),
    "train": (
        "--stage dance", "--reward much", "--collision none", "--device cuda:7", "--device tpu", "--worlds 0",
        "--worlds 1000000000", "--demonstration demo_9", "--events gone.json", "--begin-with gone", "--ppo.hidden 0",
        "--environment.action.gripper-actuators hand", "--environment.action.tool-site gone", "--iterations 0",
        "--environment.randomisation.mass 2 1", "--ppo.activation wish",
    ),
    "distil": (
        "--device cuda:7", "--images.cameras ceiling", "--images.cameras base base", "--images.networks gone",
        "--images.splats block", "--images.delay 2 1", "--network.channels 12", "--network.hidden", "--iterations 0",
        "--worlds 1000000000", "--dagger.label guess", "--size 4", "--begin-with gone", "--looks.chamfer 0.002 0.001",
    ),
    "evaluate": (
        "--world dream", "--device cuda:7", "--episodes 0", "--seed -1", "--checkpoint gone", "--action-scale 0",
        "--pretrained nobody", "-o scene.xml", "--pretrained a b",
        "--task-of shape_sorter", "--instruction dance",
        "--world simulation --record out", "--world reality --record scene.xml", "--sensors.biased lid",
    ),
    "explain": (
        "gone.h5", "--effects magic", "--jobs 0", "--action-scale 0", "--html scene.xml", "--most-trials 0",
        "--seed -1",
    ),
    "improve": (
        "--policy gone", "--world moon", "--trials gone", "--trials recording.h5", "--rounds 0", "--target 2",
        "--evaluate.hide magic=1", "--world reality --evaluate.hide magic", "-o scene.xml", "--device cuda:7",
        "--explain.effects magic",
    ),
    "play": (
        "--port -1", "--port 70000", "--device cuda:7", "--world both", "--episodes 0", "--speed 0",
        "--checkpoint gone",
    ),
    "export": (
        "--pretrained nobody", "--checkpoint gone", "-o scene.xml", "-o out.what", "--recording recording.h5",
    ),
    "splat-fit": (
        "--points gone.ply", "--longest 0", "--device cuda:7", "--fit.degree 9", "--scale 0", "--body block",
    ),
    "render-train": (
        "--cameras nobody", "--device cuda:7", "--steps 0", "--network.size 63", "--network.factors", "--flow.ema 1",
    ),
    "render": (
        "--format mp4", "--keep none", "--splats block=gone.ply", "--splats block", "--codec h999", "--size 0",
        "--networks gone", "--cameras nobody", "--pretrained", "--rate 0", "--lights.elevation 80 35",
        "--handover gone", "--handover.time 2 1", "--handover.chunk 0",
    ),
    "train-flow": (
        "--cameras nobody", "--backbone magic", "--backbone florence2", "--backbone florence2 --weights gone",
        "--weights gone", "--device cuda:7", "--policy.execute 17", "--policy.width 100", "--policy.size 2",
        "--data.state nothing", "--data.action nothing",
    ),
    "demo": (
        "--seeds -1", "--seeds one", "--engine drake", "--unseen-seeds 99999999999", "--count 0", "--fit.held-out 1",
    ),
    "record": (
        "--seeds -1", "--robot gone.xml", "--robot.tcp-site gone", "--robot.gripper-actuators gone",
        "--reality.task.timestep 1e-9", "--reality.sensing.image-size 0 1", "--rig magic", "--motion gone.h5",
        "--motion recording.h5", "--hide magic=1", "--hide joint_friction", "--rig pendulum --task stacking",
    ),
    "calibrate": (
        "--method magic", "--cameras nothing", "--tag-size 0", "--start 1 2", "--target-body nothing",
    ),
    "track": (
        "--body nothing", "--camera nothing", "--pose gone.toml", "--model gone.xml", "--masker magic", "--masker sam2",
        "--masker sam2 --masker-weights gone", "--masker-weights gone", "--points magic", "--points tapir",
        "--points tapir --points-checkout gone --points-weights gone", "--points-weights gone", "--device gpu",
        "--report scene.xml", "--live --view.host nowhere.invalid", "--click block",
        "--click block=1,2,3", "--click block=9999,5", "--click lid=5,5", "--click block=5,5@left",
        "--box block=9,9,5,5", "--box block=1,2", "--prompts gone.toml",
    ),
    "import": (
        "--episodes 5-3", "--episodes first", "--episodes 7", "--suggest --dry-run", "--calibration gone.json",
        "-o scene.xml", "--suggest", "--model gone.xml", "--map gone.toml",
    ),
}  # fmt: skip
"""Options that are wrong in other ways."""


def numeric_options(command: str) -> dict[str, tuple[str, int]]:
    """Return the kind, "INT" or "FLOAT", of each option that takes numbers, and how many it takes."""
    import tyro

    module: Any = import_module(f"concent_warp.cli.commands.{command.replace('-', '_')}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        parser = tyro.extras.get_parser(module.Arguments, config=(tyro.conf.HelptextFromCommentsOff,))
    found = {}
    for action in parser._actions:
        metavar = str(action.metavar)
        kinds = [kind for kind in ("FLOAT", "INT") if kind in metavar]
        if kinds and "STR" not in metavar:
            option = next(one for one in action.option_strings if one.startswith("--"))
            found[option] = kinds[0], 1 if "[" in metavar else metavar.count(kinds[0])
    return found


def numbers() -> Iterator[Case]:
    """Yield a senseless value for each numeric option, in the commands that have it by turns."""
    owners: dict[str, list[str]] = {}
    kinds: dict[str, tuple[str, int]] = {}
    for command in COMMANDS:
        for option, kind in numeric_options(command).items():
            owners.setdefault(option, []).append(command)
            kinds[option] = kind
    for number, (option, commands) in enumerate(owners.items()):
        kind, count = kinds[option]
        values = [value for value in SENSELESS[kind] if value != "-1" or not option.endswith(SIGNED)]
        value = values[number % len(values)]
        command = commands[number % len(commands)]
        shown = value if len(value) < 20 else "a number of 300 digits"
        line = f"{command} {NEEDED[command]} {option} {' '.join([value] * count)}"
        yield Case("options (numbers)", f"{option} {shown}", line)


def others() -> Iterator[Case]:
    """Yield options that are unknown, incomplete or name what does not exist."""
    for command, wrong in WRONG.items():
        yield Case("options (others)", "an unknown option", f"{command} {NEEDED[command]} --colour red")
        for options in wrong:
            yield Case("options (others)", options, f"{command} {NEEDED[command]} {options}")
    for command in COMMANDS:
        if command not in ("demo", "record"):
            yield Case("options (others)", "nothing is given", command)
    for line in ("dance", "--colour", "fit fit", "Fit", "--version fit x --"):
        if not line.startswith("--version"):
            yield Case("options (others)", "no such command", line)


def cases() -> Iterator[Case]:
    """Yield wrong options."""
    yield from numbers()
    yield from others()
