"""Environment steps per second of the training, beside bare MuJoCo-Warp on the same states of the same model.

    python -m benchmarks.train.throughput --out F                            # 256 to 32,768 worlds on CUDA, 8 on a CPU
    python -m benchmarks.train.throughput --out F --collisions full --worlds 256 512 1024 2048 4096 8192
    python -m benchmarks.train.throughput --out F --what ppo alternatives --worlds 8192
    python -m benchmarks.train.throughput_report F                           # the page

Every measurement is a line of the file: what is in it is not measured again, so that a run can be cut short anywhere.
What the measurements are, the page says.
"""

from __future__ import annotations

import copy
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch
import tyro

from benchmarks.measurements import Measurements, Row
from benchmarks.pages import machine
from benchmarks.train.throughput_parts import (
    bare_on_states,
    bare_rounds,
    environment_rounds,
    memory_used,
    named_kernels,
    profile,
    record_states,
    release,
    warp_physics,
)
from concent_warp.cli.terminal import quiet_warp
from concent_warp.model import Model
from concent_warp.reality.record import RealityCfg, record
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.simulate.warp_engine import preferred_device
from concent_warp.train.cfg import EnvironmentCfg, PpoCfg, TrainCfg
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.worlds import buffer_sizes, make_environment, simulation_steps
from concent_warp.train.learning.ppo import Trainer
from concent_warp.train.resets.sample import ResetStates, sample_reset_states
from concent_warp.train.run import TrainingRun
from concent_warp.train.task.task import Task

T = TypeVar("T")
Collision = Literal["vcp", "full"]
What = Literal["rate", "kernels", "ppo", "alternatives"]
COUNTS = (256, 1024, 4096, 8192, 16384, 32768)
STEPS = 16
"""Environment steps that a profile of kernels covers."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    out: Path
    """File of the measurements (.jsonl)."""
    device: str = field(default_factory=preferred_device)
    """Warp's device; the first CUDA device where there is one."""
    what: tuple[What, ...] = ("rate",)
    """Rates beside bare MuJoCo-Warp, kernels by time, rounds of PPO, or all with other settings."""
    worlds: tuple[int, ...] = ()
    """Numbers of worlds; by default 256 to 32,768 on CUDA and 8 on a CPU."""
    collisions: tuple[Collision, ...] = ("vcp",)
    """Collidable spheres: those of the contact events, or all."""
    steps: int = 40
    """Environment steps of a round."""
    repeats: int = 5
    """Rounds, of which the median counts."""
    seconds: float | None = None
    """Time after which no measurement is begun [s]."""
    settings: tuple[str, ...] = ()
    """Of the other settings, those that have one of these words in their names; by default all."""
    spheres: int = 512
    """Spheres of both objects together."""
    states: int = 512
    """Initial states."""
    cfg: EnvironmentCfg = field(default_factory=lambda: EnvironmentCfg(engine="warp"))
    """Settings of the environment; its worlds and collision are replaced."""

    @property
    def cuda(self) -> bool:
        """Whether the device is one of CUDA."""
        return self.device.startswith("cuda")

    @property
    def counts(self) -> tuple[int, ...]:
        """Numbers of worlds."""
        # From few to many: what is kept of a smaller environment is then no part of the memory of a larger one.
        return tuple(sorted(self.worlds)) or (COUNTS if self.cuda else (8,))


@dataclass(frozen=True)
class Alternative:
    """Settings that may be quicker, or show what a setting costs."""

    environment: dict[str, Any] = field(default_factory=dict)
    """Changed settings of the environment."""
    threads: int | None = None
    """Changed threads of a world's virtual collisions."""
    points: int | None = None
    """Changed number of points of each object's surface in those."""
    touching: bool = False
    """Of the robot, leave in the physics what takes part in a contact event alone, as of the objects."""


TIGHT = {"nconmax": 64, "njmax": 256}
PYRAMIDS = {"cone": "pyramidal"}
COARSE = {**PYRAMIDS, "stride": 2}
ALTERNATIVES = {
    "as it is": Alternative(),
    "pyramidal cones": Alternative(PYRAMIDS),
    "steps twice as long": Alternative({"stride": 2}),
    "pyramidal cones, steps twice as long": Alternative(COARSE),
    "pyramidal cones, 6 iterations": Alternative({**PYRAMIDS, "solver_iterations": 6}),
    "pyramidal cones, steps twice as long, 6 iterations": Alternative({**COARSE, "solver_iterations": 6}),
    "pyramidal cones, steps twice as long, sparse": Alternative({**COARSE, "jacobian": "sparse"}),
    "without points": Alternative(points=0),
    "sparse": Alternative({"jacobian": "sparse"}),
    "4 iterations": Alternative({"solver_iterations": 4}),
    "6 iterations": Alternative({"solver_iterations": 6}),
    "6 iterations, 20 of the line search": Alternative({"solver_iterations": 6, "ls_iterations": 20}),
    "64 contacts, 256 rows": Alternative(TIGHT),
    "6 iterations, 64 contacts, 256 rows": Alternative({**TIGHT, "solver_iterations": 6}),
    "touching links alone": Alternative(touching=True),
    "32 threads": Alternative(threads=32),
    "64 threads": Alternative(threads=64),
    "fused": Alternative({"fuse": True}),
    "torch outside of graphs": Alternative({"capture": "physics"}),
}
PPO_ALTERNATIVES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "as it is": ({}, {}),
    "pyramidal cones": (PYRAMIDS, {}),
    "pyramidal cones, steps twice as long": (COARSE, {}),
    "pyramidal cones, steps twice as long, fused": ({**COARSE, "fuse": True}, {}),
    "pyramidal cones, steps twice as long, 2 epochs": (COARSE, {"epochs": 2}),
    "pyramidal cones, steps twice as long, 2 batches": (COARSE, {"batches": 2}),
    "products in float32": ({}, {"tf32": False}),
    "2 batches": ({}, {"batches": 2}),
}


def make_run(spheres: int) -> TrainingRun:
    """Return the training of the shape sorter's insertion."""
    recording, _ = record(RealityCfg(), [0])
    scene = Scene(recording.scene)
    return TrainingRun.new(Model(scene, ContactGeometryCfg(count=spheres).build(scene)), recording, TrainCfg())


@dataclass
class Bench:
    """What the measurements share."""

    args: Args
    run: TrainingRun
    tasks: dict[str, tuple[Task, ResetStates]] = field(default_factory=dict)
    base: int | None = None
    """Memory in use before anything large is made [byte]."""
    room: tuple[int, int] | None = None
    """Contacts and rows a world that were found to fit all spheres so far."""

    def task(self, collision: str) -> tuple[Task, ResetStates]:
        """Return the task with a set of spheres, and its initial states."""
        if collision not in self.tasks:
            cfg = replace(self.args.cfg, collision=collision)
            task = Task.build(self.run.model, self.run.recording[0], cfg, self.run.events)
            states = sample_reset_states(task, cfg.reset, 0, count=self.args.states)
            self.tasks[collision] = task, states
        return self.tasks[collision]

    def base_memory(self) -> int:
        """Return the memory that is in use after a small environment, for modules and the like [byte]."""
        if self.base is None:
            task, states = self.task("vcp")
            small = make_environment(task, replace(self.args.cfg, worlds=16), states, device=self.args.device)
            with torch.inference_mode():
                environment_rounds(small, random_actions(small), 2, 1)
            del small
            release()
            self.base = memory_used(self.args.device)
        return self.base

    def rate(self, cfg: EnvironmentCfg, task: Task, states: ResetStates) -> Row:
        """Return rates, profile, contacts dropped and memory of an environment."""
        args = self.args
        before = self.base_memory()
        environment = make_environment(task, cfg, states, device=args.device)
        actions = random_actions(environment)
        with torch.inference_mode():
            environment.reset()
            environment_rounds(environment, actions, args.steps, 1)
            environment.read_log()
            rounds = environment_rounds(environment, actions, args.steps, args.repeats)
            log = environment.read_log()
            parts = profile(environment, actions, args.steps)
            used = memory_used(args.device) - before
            tape = record_states(environment, actions, args.steps)
            bare, solver = bare_on_states(environment, tape, simulation_steps(environment.task.compiled, cfg))
            held = bare_rounds(environment, simulation_steps(environment.task.compiled, cfg), args.steps, 2)
        return {
            **facts(task, cfg),
            **dict(zip(("nconmax", "njmax"), warp_physics(environment).buffers or (), strict=True)),
            "environment_ms": rounds,
            "bare_ms": bare,
            "bare_held_ms": held,
            "profile_ms": parts,
            "solver_iterations": solver,
            "contacts": tape.contacts,
            "rows": tape.rows,
            "dropping": tape.dropping,
            "overflow": log["overflow"],
            "diverged": log["diverged worlds"],
            "episodes": log["episodes"],
            "memory_gib": used / 2**30,
        }

    def fitting(self, cfg: EnvironmentCfg, task: Task, states: ResetStates) -> Row:
        """Return the rate with buffers that nothing overflows, found by doubling those that did."""
        tried = []
        while True:
            contacts, rows = self.room or buffer_sizes(task, cfg)
            cfg = replace(cfg, nconmax=contacts, njmax=rows)
            dropping = self.dropping(cfg, task, states)
            tried.append([contacts, rows, dropping])
            if not dropping:
                break
            self.room = contacts * (1 + ("nconmax" in dropping)), rows * (1 + ("njmax" in dropping))
            print(f"  {contacts} contacts, {rows} rows a world: {' and '.join(dropping)} too small", flush=True)
        return {**self.rate(cfg, task, states), "tried": tried}

    def dropping(self, cfg: EnvironmentCfg, task: Task, states: ResetStates) -> list[str]:
        """Return the buffers that are too small in some step."""
        environment = make_environment(task, cfg, states, device=self.args.device)
        with torch.inference_mode():
            environment.reset()
            found = record_states(environment, random_actions(environment), 2 * self.args.steps, states=False).dropping
        del environment
        release()
        return found

    def ppo(self, cfg: EnvironmentCfg, task: Task, states: ResetStates, ppo: PpoCfg) -> Row:
        """Return times of rounds of PPO."""
        environment = make_environment(task, cfg, states, device=self.args.device)
        settings = TrainCfg(environment=cfg, ppo=replace(ppo, iterations=2 + self.args.repeats))
        trainer = Trainer(environment, settings)
        environment.reset()
        trainer.learn()
        rounds = trainer.history[2:]
        return {
            **facts(task, cfg),
            "steps": settings.ppo.steps,
            "collecting_ms": [1e3 * this.collecting for this in rounds],
            "updating_ms": [1e3 * this.updating for this in rounds],
            "overflow": rounds[-1].log["overflow"],
            "diverged": sum(this.log["diverged worlds"] for this in rounds),
        }

    def kernels(self, cfg: EnvironmentCfg, task: Task, states: ResetStates) -> Row:
        """Return the kernels that take most time."""
        environment = make_environment(task, cfg, states, device=self.args.device)
        with torch.inference_mode():
            environment.reset()
            rows = named_kernels(environment, random_actions(environment), STEPS)
        return {**facts(task, cfg), "steps": STEPS, "kernels": rows}


def facts(task: Task, cfg: EnvironmentCfg) -> Row:
    """Return what a measurement is of."""
    return {
        "collision": cfg.collision,
        "spheres": int(task.collidable.sum()),
        "worlds": cfg.worlds,
        "decimation": cfg.decimation,
        "stride": cfg.decimation // simulation_steps(task.compiled, cfg),
    }


def random_actions(environment: Environment) -> torch.Tensor:
    """Return actions of 16 steps, shape (16, N, A)."""
    return 0.5 * torch.randn(16, environment.num_envs, environment.num_actions, device=environment.device)


def altered(task: Task, other: Alternative) -> Task:
    """Return a task, with less of the robot in its physics if asked for."""
    if not other.touching:
        return task
    compiled = copy.copy(task.compiled)
    touching = {compiled.body(entity.body).id for entity in task.events.entities}
    idle = ~np.isin(compiled.geom_bodyid, sorted({0, *task.objects, *touching}))
    compiled.geom_contype[idle] = compiled.geom_conaffinity[idle] = 0
    return replace(task, compiled=compiled)


def settings(cfg: EnvironmentCfg, other: Alternative) -> EnvironmentCfg:
    """Return the settings of an alternative."""
    virtual = cfg.virtual
    virtual = virtual if other.threads is None else replace(virtual, threads=other.threads)
    virtual = virtual if other.points is None else replace(virtual, points=other.points)
    return replace(cfg, **other.environment, virtual=virtual)


def chosen(among: Mapping[str, T], words: Sequence[str]) -> list[tuple[str, T]]:
    """Return the settings, with their names, that have one of some words in their names; all for no words."""
    return [(name, given) for name, given in among.items() if not words or any(word in name for word in words)]


def attempt(kept: Measurements, key: str, expected: float, measure: Callable[[], Row], device: str) -> None:
    """Measure, unless it is measured or there is no time; keep an error in place of a result."""
    if not kept.wanted(key, expected):
        return
    try:
        row = measure()
    except Exception as error:  # one that fails, for want of memory say, must not end the others
        traceback.print_exc()
        row = {"error": f"{type(error).__name__}: {error}"[:300]}
    kept.add(key, {"machine": machine(device), **row})
    del row
    release()


def main() -> None:
    """Measure."""
    args = tyro.cli(Args, description=__doc__)
    names = {*ALTERNATIVES, *PPO_ALTERNATIVES}
    if strange := [word for word in args.settings if not any(word in name for name in names)]:
        raise SystemExit(f"--settings: {strange[0]!r} is in no name of {', '.join(sorted(names))}")
    quiet_warp()
    kept = Measurements(args.out, seconds=args.seconds)
    bench = Bench(args, make_run(args.spheres))
    for what in args.what:
        for collision in args.collisions:
            for worlds in args.counts:
                cfg = replace(args.cfg, collision=collision, worlds=worlds)
                measure_one(bench, kept, what, cfg)
    kept.close()


def measure_one(bench: Bench, kept: Measurements, what: What, cfg: EnvironmentCfg) -> None:
    """Take one kind of measurements with one environment."""
    name = f"{what} {cfg.collision} {cfg.worlds}" + " fused" * cfg.fuse

    def one(key: str, expected: float, measure: Callable[[], Row]) -> None:
        attempt(kept, key, expected, measure, bench.args.device)

    task, states = bench.task(cfg.collision)
    if what == "rate" and cfg.collision == "vcp":
        one(name, 30, lambda: bench.rate(cfg, task, states))
    elif what == "rate":
        contacts, rows = buffer_sizes(bench.task("vcp")[0], cfg)
        fixed = replace(cfg, nconmax=contacts, njmax=rows)
        one(f"{name} fixed", 30, lambda: bench.rate(fixed, task, states))
        one(f"{name} fitting", 60, lambda: bench.fitting(cfg, task, states))
    elif what == "kernels":
        one(name, 30, lambda: bench.kernels(cfg, task, states))
    elif what == "ppo":
        one(name, 30, lambda: bench.ppo(cfg, task, states, PpoCfg()))
    else:
        for title, other in chosen(ALTERNATIVES, bench.args.settings):
            one(f"{name}: {title}", 30, partial(bench.rate, settings(cfg, other), altered(task, other), states))
        for title, (environment, ppo) in chosen(PPO_ALTERNATIVES, bench.args.settings):
            changed = replace(cfg, **environment), task, states, replace(PpoCfg(), **ppo)
            one(f"{name}, PPO: {title}", 30, partial(bench.ppo, *changed))


if __name__ == "__main__":
    main()
