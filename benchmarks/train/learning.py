"""Trainings of several cases and seeds, sequential or in parallel on several GPUs, and their learning curves.

    python -m benchmarks.train.cases --out runs/table1
    python -m benchmarks.train.learning --out runs/table1 --cases ours engineered --seconds 60
    python -m benchmarks.train.learning --out runs/table1 --gpus 0 1 2 3 4 5 6 7    # all cases, one training a GPU
    python -m benchmarks.train.learning_report runs/table1                          # the page

Each training has a process of its own and a folder: run folder, a curve with a line each round, and at the end the
success of the policy without exploration in simulation, from initial states that it has not seen. A training that has
ended is not repeated, one that was stopped goes on from its checkpoint. Trainings that share a GPU are slower together
than one alone: three on an NVIDIA H200 made 84 k steps/s in all, one 95 k. `--pack` copies what is needed to evaluate
the policies elsewhere, and the curves, into tar files.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import tarfile
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import tyro

from benchmarks.pages import machine
from benchmarks.train.cases import CASES, Case, material
from concent_warp.cli.commands.train import given_stage
from concent_warp.files import write_text
from concent_warp.train.cfg import LAST, TrainCfg
from concent_warp.train.learning.metrics import CURVE
from concent_warp.train.run import TrainingRun, train_run

RESULT, POLICY, LOG = "result.json", "policy", "log.txt"
PACKED = 14 * 2**20
"""Largest packed file [byte]."""
OF_A_CASE = (
    "seed",
    "checkpoint",
    "ppo.iterations",
    "environment.worlds",
    "environment.stage",
    "environment.reward.kind",
    "environment.reset.before",
)
"""Settings that tell cases and lengths of a training apart, and not how it is done."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    out: Path
    """Folder with the models that train_cases.py made; the trainings go to its folder runs."""
    cases: tuple[str, ...] = tuple(CASES)
    seeds: tuple[int, ...] = (0, 1, 2)
    gpus: tuple[int, ...] = ()
    """Numbers of the GPUs to train on, one training each at a time; where none is given, the first device."""
    seconds: float | None = 60.0
    """Time of learning after which a training ends [s]; None for all rounds."""
    stage: Literal["insert", "all"] = "insert"
    """Insertion alone, or all stages chained."""
    episodes: int = 1000
    """Episodes of the evaluation in simulation, and of the stress test."""
    limit: float | None = None
    """Time after which no training is begun and those that run are stopped, to be gone on with [s]."""
    pack: Path | None = None
    """Folder to pack the results into."""
    device: str | None = None
    """Warp's name of the device; by default the first GPU where there is one."""
    one: tuple[str, int] | None = None
    """Train this case and seed here and now; the others are for the process that starts these."""
    train: TrainCfg = field(default_factory=lambda: TrainCfg(checkpoint=25))


def folder_of(args: Args, case: str, seed: int) -> Path:
    """Return the folder of a training."""
    return args.out / "runs" / f"{case}_{args.stage}_{seed}"


def train_one(args: Args, name: str, seed: int) -> None:
    """Train a case with a seed, and try the policy in simulation."""
    begun = time.monotonic()
    from concent_warp.cli.terminal import quiet_warp
    from concent_warp.simulate.warp_engine import preferred_device
    from concent_warp.train.learning.ppo import CHECKPOINT, Iteration, load_checkpoint
    from concent_warp.train.policy.load import Policy
    from concent_warp.train.policy.write_pretrained import write_pretrained

    quiet_warp()
    case, folder, device = CASES[name], folder_of(args, name, seed), args.device or preferred_device()
    model, recording = material(args.out, case, seed)
    run = with_stage(TrainingRun.new(model, recording, settings(args, case, seed)), args.stage)
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = folder / CHECKPOINT

    def note(this: Iteration) -> None:
        if this.iteration % 10 == 1:
            print(f"{folder.name}: {this.seconds:.0f} s, {this.log['success']:.1%}", flush=True)

    resume, left = checkpoint.is_file(), args.seconds
    if resume and left is not None:
        left = max(left - load_checkpoint(checkpoint)["seconds"], 0.0)
    trainer, _ = train_run(run, folder, device=device, resume=resume, report=note, seconds=left)
    learnt = time.monotonic() - begun
    result = {
        "case": name,
        "seed": seed,
        "stage": run.cfg.environment.stage,
        "machine": machine(device),
        "worlds": run.cfg.environment.worlds,
        "steps": trainer.steps,
        "seconds": trainer.seconds,
        "start_seconds": learnt - trainer.seconds,
        "settings": json.loads(json.dumps(asdict(run.cfg))),
    }
    del trainer
    result["simulation"] = simulated(run, checkpoint, args, device)
    result["stress"] = stressed(run, checkpoint, args, device)
    write_pretrained(Policy.load(checkpoint), folder / POLICY, overwrite=True)
    write_text(folder / RESULT, json.dumps(result, indent=1))
    print(f"{folder.name}: {result['simulation']['rate']:.2%} after {result['seconds']:.0f} s", flush=True)


def settings(args: Args, case: Case, seed: int) -> TrainCfg:
    """Return the settings of a training."""
    environment = args.train.environment
    environment = replace(environment, stage=args.stage, reward=replace(environment.reward, kind=case.reward))
    return replace(args.train, seed=seed, environment=environment)


def changed(settings: Mapping[str, Any]) -> str:
    """Return the settings of a training that are not the default, as options, but for those that belong to a case."""
    mine = flat(settings)
    default = flat(json.loads(json.dumps(asdict(TrainCfg.for_stage(mine.get("environment.stage", LAST))))))
    parts = []
    for name, value in mine.items():
        if name in default and value != default[name] and name not in OF_A_CASE:
            values = value if isinstance(value, list) else [value]
            parts.append(f"--{name.replace('_', '-')} {' '.join(map(str, values))}")
    return " ".join(parts)


def flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings by their full names."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return found


def with_stage(run: TrainingRun, stage: str) -> TrainingRun:
    """Return a run of a stage, or of the last one where there is none of that name.

    Of the shape sorter that is the last one that the model shows. Its episodes begin shortly before it, not with the
    stage before, as those of the insertion begin about the hole: what is compared is the end of the task.
    """
    stages = run.events.stages
    if stage == "all" or stage in [one.name for one in stages]:
        return run
    *earlier, last = stages
    if run.model.scene.spec().modelname != "shape_sorter":
        return replace(run, cfg=replace(run.cfg, environment=replace(run.cfg.environment, stage=last.name)))
    since = last.start - (earlier[-1].start if earlier else 0.0)
    environment = run.cfg.environment
    reset = replace(environment.reset, before=environment.reset.before - since)
    return replace(run, cfg=replace(run.cfg, environment=replace(environment, stage=last.name, reset=reset)))


def simulated(run: TrainingRun, checkpoint: Path, args: Args, device: str) -> dict[str, Any]:
    """Return what the policy without exploration does in simulation, from states that training has not seen."""
    from concent_warp.train.environment.worlds import make_environment
    from concent_warp.train.policy.load import Policy
    from concent_warp.train.trials.evaluate import run_episodes

    task = run.task()
    states = run.evaluation_states(task, args.episodes, run.cfg.seed)
    cfg = replace(run.cfg.environment, worlds=min(args.episodes, run.cfg.environment.worlds))
    environment = make_environment(task, cfg, states, device=device)
    policy = replace(Policy.load(checkpoint), run=run)
    found = run_episodes(environment, policy.act_in(environment), states).to_json()
    return {name: found[name] for name in ("episodes", "successes", "rate", "interval")}


def stressed(run: TrainingRun, checkpoint: Path, args: Args, device: str) -> dict[str, Any]:
    """Return what the policy does in the stress test, from other states than those by which it was chosen."""
    from concent_warp.train.policy.load import Policy

    test = run.stress_test(device=device, episodes=args.episodes, seed=run.cfg.seed)
    policy = replace(Policy.load(checkpoint), run=run)
    found = test(policy.act_in(test.environment)).to_json()
    return {name: found[name] for name in ("episodes", "successes", "rate", "interval")}


def work(args: Args, gpu: int | None, jobs: queue.Queue[tuple[str, int]], ends: float | None) -> None:
    """Train one job after the other on a GPU until there is none left or time is up."""
    while ends is None or time.monotonic() < ends - (args.seconds or 0):
        try:
            name, seed = jobs.get_nowait()
        except queue.Empty:
            return
        folder = folder_of(args, name, seed)
        folder.mkdir(parents=True, exist_ok=True)
        visible = {} if gpu is None else {"CUDA_VISIBLE_DEVICES": str(gpu)}
        command = [sys.executable, "-m", "benchmarks.train.learning", *sys.argv[1:], "--one", name, str(seed)]
        with (folder / LOG).open("a") as log:
            process = subprocess.Popen(command, env={**os.environ, **visible}, stdout=log, stderr=subprocess.STDOUT)
            try:
                code = process.wait(None if ends is None else max(ends - time.monotonic(), 1.0))
            except subprocess.TimeoutExpired:
                process.terminate()
                process.wait()
                code = "stopped"
        lines = (folder / LOG).read_text().strip().splitlines()
        print(f"GPU {gpu}: {name} {seed}, exit {code}: {lines[-1][:200] if lines else ''}", flush=True)


def pack(args: Args) -> None:
    """Pack curves, results and policies into tar files of a bearable size."""
    assert args.pack is not None
    args.pack.mkdir(parents=True, exist_ok=True)
    wanted = (CURVE, RESULT, POLICY, LOG)
    groups: list[list[Path]] = [[]]
    room = PACKED
    for path in sorted(one for one in (args.out / "runs").glob("*/*") if one.name in wanted):
        length = sum(one.stat().st_size for one in (path, *path.rglob("*")) if one.is_file())
        if length > room:
            groups.append([])
            room = PACKED
        groups[-1].append(path)
        room -= length
    for number, group in enumerate(groups):
        with tarfile.open(args.pack / f"runs_{number}.tar", "w") as tar:
            for path in group:
                tar.add(path, path.relative_to(args.out))
    print(f"packed {sum(map(len, groups))} files and folders into {len(groups)}", flush=True)


def main() -> None:
    """Train what is left."""
    defaults = replace(TrainCfg.for_stage(given_stage(sys.argv)), checkpoint=25)
    args = tyro.cli(Args, description=__doc__, default=Args(out=tyro.MISSING, train=defaults))
    if args.one is not None:
        train_one(args, *args.one)
        return
    ends = None if args.limit is None else time.monotonic() + args.limit
    jobs: queue.Queue[tuple[str, int]] = queue.Queue()
    for seed in args.seeds:
        for name in args.cases:
            if not (folder_of(args, name, seed) / RESULT).is_file():
                jobs.put((name, seed))
    print(f"{jobs.qsize()} trainings are left", flush=True)
    threads = [threading.Thread(target=work, args=(args, gpu, jobs, ends)) for gpu in args.gpus or (None,)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if args.pack is not None:
        pack(args)


if __name__ == "__main__":
    main()
