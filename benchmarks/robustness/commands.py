"""Every command that writes files, at a small size, with the inputs that they share."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.pages import ROOT

SERVO = ROOT / "concent_warp" / "examples" / "servo.h5"
SHIPPED = ROOT / "train" / "pretrained" / "shape_sorter"
QUICK = "--reality.expert.speed 2"
SPHERES, GENERATIONS, POPULATION = 60, 4, 4
RECORDING, MODEL, SERVO_MODEL, TRAINED, TRIALS, PHOTOGRAPHS, FOOTAGE, VIDEO, LOG, DATASET, OPEN_DIAGNOSIS = (
    "demo.h5", "model.toml", "servo.toml", "trained", "trials", "photographs", "empty.h5", "video.h5", "log",
    "dataset", "found.json",
)  # fmt: skip
"""Names of the inputs."""
TRAIN = (
    f"train {SHIPPED}/demonstration.h5 --model {SHIPPED}/model.toml --events {SHIPPED}/events.json --stage insert "
    "--worlds 4 --ppo.steps 4 --ppo.hidden 16 --environment.reset.states 8 --device cpu --checkpoint 2"
)
NETWORKS = (
    "--network.size 16 --network.width 16 --network.factors 1 2 --flow.batch 8 --enlarge.batch 8 "
    "--super-resolution.width 16 --super-resolution.blocks 2 --crop 10 --device cpu"
)
DISTIL = (
    "distil shape_sorter --states 4 --size 16 --images.samples 1 --worlds 2 --dagger.steps 2 --dagger.updates 2 "
    "--dagger.batch 4 --network.channels 8 8 --network.hidden 16 --device cpu"
)
TRAIN_FLOW = (
    f"train-flow {{inputs}}/{DATASET} --batch 4 --checkpoint 0.2 --policy.size 16 --policy.width 16 --policy.layers 1 "
    "--policy.heads 2 --policy.small.channels 8 8 8 --policy.small.text-layers 0 --device cpu --out {out}/run"
)
LIMIT = 600.0
"""Time after which a command counts as stuck [s]."""


@dataclass(frozen=True)
class Writing:
    """A command that writes files; "{inputs}" and "{out}" in it stand for folders."""

    name: str
    line: str

    def words(self, inputs: Path, out: Path, *more: str) -> list[str]:
        """Return the words of the command line after ``concent``."""
        return [*(word.format(inputs=inputs, out=out) for word in self.line.split()), *more]


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    """Exit status; negative after a signal."""
    out: str
    said: list[str]
    """Lines on standard error that are neither progress nor empty."""
    seconds: float


def _fit(generations: int) -> str:
    """Return the settings of a small fit."""
    sizes = f"--count {SPHERES} --fit.generations {generations} --fit.evolution.population {POPULATION}"
    return f"{sizes} --engine mujoco"


FIT = f"fit {{inputs}}/{RECORDING} --out {{out}}/run {_fit(GENERATIONS)}"
RENDER = "render --pretrained --episodes 4 --worlds 2 --size 32 --cameras base --device cpu --keep all --out {out}/data"
WRITING = [
    Writing("record", f"record --out {{out}}/demo.h5 --seeds 0 {QUICK}"),
    Writing(
        "import", f"import {{inputs}}/{LOG} --model {{inputs}}/log.xml --map {{inputs}}/map.toml --out {{out}}/demo.h5"
    ),
    Writing(
        "calibrate",
        f"calibrate {{inputs}}/{VIDEO} --method robot --out {{out}}/demo.h5 --picture {{out}}/picture.png",
    ),
    Writing("track", f"track {{inputs}}/{VIDEO} --out {{out}}/tracked.h5 --report {{out}}/track.html"),
    Writing(
        "geometry", f"geometry {{inputs}}/{RECORDING} --count {SPHERES} --out {{out}}/m.toml --export {{out}}/m.xml"
    ),
    Writing("fit", FIT),
    Writing("demo", f"demo --out {{out}}/run --unseen-seeds 1 {QUICK} {_fit(1)}"),
    Writing("replay", f"replay {{inputs}}/{RECORDING} --model {{inputs}}/{MODEL} --out {{out}}/rollout.npz"),
    Writing("events", f"events {{inputs}}/{RECORDING} --model {{inputs}}/{MODEL} --out {{out}}"),
    Writing("compare", f"compare {SERVO} --model {{inputs}}/{SERVO_MODEL} --html {{out}}/report.html"),
    Writing(
        "diagnose",
        f"diagnose {SERVO} --effects joint_friction --jobs 1 --out {{out}}/pieces --apply {{out}}/m.toml "
        "--html {out}/report.html",
    ),
    Writing(
        "suggest",
        f"suggest {SERVO} --diagnosis {{inputs}}/{OPEN_DIAGNOSIS} --method menu --out {{out}}/motion.h5",
    ),
    Writing("locate", f"locate {SERVO} --png {{out}}/forces.png --html {{out}}/report.html"),
    Writing("add", f"add joint_friction --model {{inputs}}/{SERVO_MODEL} --fit {SERVO} --out {{out}}/m.toml"),
    Writing("train", f"{TRAIN} --iterations 4 --out {{out}}/run"),
    Writing("distil", f"{DISTIL} --iterations 4 --out {{out}}/run"),
    Writing(
        "evaluate",
        f"evaluate --checkpoint {{inputs}}/{TRAINED} --world reality --episodes 2 --videos 2 --device cpu "
        "--out {out} --record {out}/trials",
    ),
    Writing(
        "explain",
        f"explain {{inputs}}/{TRAINED} {{inputs}}/{TRIALS} --no-diagnose --most-trials 1 --repetitions 2 "
        "--html {out}/page.html --out {out}/run",
    ),
    Writing(
        "improve",
        f"improve {SHIPPED}/demonstration.h5 --policy {{inputs}}/{TRAINED} --trials {{inputs}}/{TRIALS} --rounds 1 "
        "--iterations 2 --worlds 4 --explain.no-diagnose --explain.most-trials 1 --explain.repetitions 2 "
        "--explain.simulated 2 --device cpu --out {out}/run",
    ),
    Writing("export, ONNX", f"export --checkpoint {{inputs}}/{TRAINED} --out {{out}}/policy.onnx"),
    Writing("export, TorchScript", f"export --checkpoint {{inputs}}/{TRAINED} --out {{out}}/policy.pt"),
    Writing("export, pretrained", f"export --checkpoint {{inputs}}/{TRAINED} --out {{out}}/policy --as-pretrained"),
    Writing(
        "splat-fit",
        f"splat-fit {{inputs}}/{PHOTOGRAPHS} --out {{out}}/run --fit.start 300 --fit.held-out 4 --fit.iterations 20 "
        "--device cpu",
    ),
    Writing("render-train", f"render-train {{inputs}}/{FOOTAGE} --out {{out}}/run --steps 10 {NETWORKS}"),
    Writing("render, LeRobot", f"{RENDER} --format lerobot --films 1 --figure {{out}}/layers.png"),
    Writing("train-flow", f"{TRAIN_FLOW} --steps 10"),
    Writing("render, robomimic", f"{RENDER} --format robomimic --films 1 --figure {{out}}/layers.png"),
]


def launch(words: Sequence[str], folder: Path, name: str, *, before: Sequence[str] = ()) -> subprocess.Popen[bytes]:
    """Start ``concent`` in a session of its own; its output goes to `name`.out and `name`.err in a folder.

    Args:
        words: Words after ``concent``.
        folder: Working directory.
        name: Name of the files.
        before: What starts the package in place of Python alone, such as torchrun's module and options.
    """
    with (folder / f"{name}.out").open("wb") as out, (folder / f"{name}.err").open("wb") as said:
        return subprocess.Popen(
            [sys.executable, *before, "-m", "concent_warp", *words],
            cwd=folder,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=said,
            start_new_session=True,
        )


def ended(process: subprocess.Popen[bytes], folder: Path, name: str, begun: float) -> Ended:
    """Wait for a command that `launch` started, and return how it ended."""
    code = process.wait(LIMIT)
    lines = (folder / f"{name}.err").read_text(errors="replace").splitlines()
    said = [line for line in lines if line.startswith("concent ") and not line.endswith("loading ...")]
    traces = [line for line in lines if "Traceback" in line or "Fatal Python error" in line]
    return Ended(code, (folder / f"{name}.out").read_text(), said + traces, time.monotonic() - begun)


def run(words: Sequence[str], folder: Path, name: str = "last", *, before: Sequence[str] = ()) -> Ended:
    """Run ``concent`` to its end, see `launch`."""
    begun = time.monotonic()
    return ended(launch(words, folder, name, before=before), folder, name, begun)


def prepare(inputs: Path, names: Sequence[str] | None = None) -> None:
    """Make the inputs that are missing, all or those of some names."""
    inputs.mkdir(parents=True, exist_ok=True)
    given = {
        RECORDING: f"record --out {RECORDING} --seeds 0 1 {QUICK}",
        MODEL: f"geometry {RECORDING} --count {SPHERES} --out {MODEL}",
        SERVO_MODEL: f"add joint_damping --model servo.xml --out {SERVO_MODEL}",
        TRAINED: f"{TRAIN} --iterations 2 --out {TRAINED}",
        DATASET: f"render --pretrained --episodes 2 --size 32 --cameras base --device cpu --keep all --out {DATASET}",
        TRIALS: f"evaluate --checkpoint {TRAINED} --world reality --episodes 2 --device cpu --record {TRIALS}",
        FOOTAGE: f"record --out {FOOTAGE} --seeds 10 {QUICK} --reality.footage.cameras base "
        "--reality.footage.size 64 64 --reality.footage.rate 5 --reality.footage.no-objects",
        VIDEO: f"record --out {VIDEO} --seeds 0 {QUICK} --reality.sensing.images --reality.sensing.image-rate 10 "
        "--reality.sensing.image-size 180 240",
    }
    for name, line in given.items():
        if (names is None or name in names) and not (inputs / name).exists():
            if name == SERVO_MODEL:
                from concent_warp.recording.load import load_recording

                (inputs / "servo.xml").write_text(load_recording(SERVO).scene)
            done = run(line.split(), inputs)
            if done.code:
                raise SystemExit(f"concent {line}: status {done.code}: {done.said}")
            print(f"made {name} in {done.seconds:.0f} s", flush=True)
    if (names is None or OPEN_DIAGNOSIS in names) and not (inputs / OPEN_DIAGNOSIS).exists():
        from benchmarks.bad_input.sound_inputs import open_diagnosis

        (inputs / OPEN_DIAGNOSIS).write_text(json.dumps(open_diagnosis("hinge", 0.03)))
    if (names is None or PHOTOGRAPHS in names) and not (inputs / PHOTOGRAPHS / "transforms.json").exists():
        _photograph(inputs / PHOTOGRAPHS)
    if (names is None or LOG in names) and not (inputs / LOG).exists():
        from benchmarks.bad_input.sound_inputs import SCENE, write_log

        write_log(inputs)
        (inputs / "log.xml").write_text(SCENE)


def _photograph(folder: Path) -> None:
    """Write small photographs of the block."""
    from concent_warp.reality.sensors.photographs import PhotographsCfg, photographs
    from concent_warp.reality.world import WorldCfg
    from concent_warp.render.splats.views import SplatViews
    from concent_warp.scene.shape_sorter import ShapeSorterCfg

    folder.mkdir(exist_ok=True)
    world = WorldCfg().build(ShapeSorterCfg().build())
    SplatViews(*photographs(world, "block", PhotographsCfg(count=16, size=40)), masked=True).write(folder)
