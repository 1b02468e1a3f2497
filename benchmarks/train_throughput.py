"""Environment steps per second of the training, beside bare MuJoCo-Warp on the same model, step and decimation.

    python benchmarks/train_throughput.py                       # 256 to 32,768 worlds on CUDA, 8 on a CPU
    python benchmarks/train_throughput.py --collisions vcp full # both sets of collidable spheres
    python benchmarks/train_throughput.py --table               # the page from the stored results

The task is the insertion stage of the shape sorter with the arm. A step of an environment is one action, so
`decimation` steps of the simulator. *bare* is `mujoco_warp.step`, as many of them captured in one graph, launched again
and again on states of the same kind, and nothing else. *environment* is the whole of `Environment.step` with random
actions and no learning: commands, physics, contact pairs, virtual collisions, reward, resets, observation. *PPO* is a
round of rsl-rl's PPO, collecting and updating. Compilation and capture are in none of them.

The profile times the parts of a step one after the other, each waited for, so that they add up to more than a step.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import mujoco_warp as mjw
import torch
import tyro
import warp as wp
from concent_warp.train.cfg import EnvironmentCfg, PpoCfg, TrainCfg
from concent_warp.train.environment import Environment
from concent_warp.train.physics import Graph, WarpPhysics
from concent_warp.train.ppo import Trainer
from concent_warp.train.resets import InitialStates, draw_states
from concent_warp.train.run import Run
from concent_warp.train.task import Task
from concent_warp.train.worlds import make_environment
from pages import machine, machine_line, read_data, table, write_data, write_page

from concent_warp.cli.terminal import quiet_warp
from concent_warp.model import Model
from concent_warp.reality.record import RealityCfg, record
from concent_warp.scene.build_geometry import ContactGeometryCfg
from concent_warp.scene.scene import Scene
from concent_warp.simulate.warp_engine import preferred_device

NAME = "train_throughput"
Collision = Literal["vcp", "full"]
PARTS = ("command", "physics", "distances", "judge", "poses and pairs", "observe")


@dataclass(frozen=True)
class Args:
    """Command line."""

    device: str = field(default_factory=preferred_device)
    """Warp's device; the first CUDA device where there is one."""
    worlds: tuple[int, ...] = ()
    """Numbers of worlds; by default 256 to 32,768 on CUDA and 8 on a CPU."""
    collisions: tuple[Collision, ...] = ("vcp",)
    """Collidable spheres: those of the contact events, or all."""
    steps: int = 50
    """Environment steps of a measurement."""
    repeats: int = 3
    """Measurements, of which the fastest counts."""
    ppo: bool = True
    """Also measure rounds of PPO."""
    spheres: int = 512
    """Spheres of both objects together."""
    states: int = 512
    """Initial states."""
    cfg: EnvironmentCfg = field(default_factory=lambda: EnvironmentCfg(engine="warp"))
    """Settings of the environment; its worlds and collision are replaced."""
    table: bool = False
    """Write the page from the stored results, without runs."""


def make_run(spheres: int) -> Run:
    """Return the training of the shape sorter's insertion."""
    recording, _ = record(RealityCfg(), [0])
    scene = Scene(recording.scene)
    return Run.new(Model(scene, ContactGeometryCfg(count=spheres).build(scene)), recording, TrainCfg())


def seconds(part: Callable[[], object], steps: int, repeats: int, device: str) -> float:
    """Return the shortest time of one call [s], of `repeats` loops of `steps` calls."""
    part()
    times = []
    for _ in range(repeats):
        wp.synchronize_device(device)
        start = time.perf_counter()
        for _ in range(steps):
            part()
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        wp.synchronize_device(device)
        times.append((time.perf_counter() - start) / steps)
    return min(times)


def bare(environment: Environment, decimation: int, device: str) -> Callable[[], None]:
    """Return the steps of one action in bare MuJoCo-Warp, on the environment's own worlds."""
    physics = environment.physics
    assert isinstance(physics, WarpPhysics)
    m, d = physics.simulator

    def steps() -> None:
        for _ in range(decimation):
            mjw.step(m, d)

    return Graph(steps, wp.get_device(device), True).launch


def measure(task: Task, states: InitialStates, cfg: EnvironmentCfg, args: Args) -> dict[str, Any]:
    """Return the figures of one number of worlds."""
    device = args.device
    begun = time.perf_counter()
    environment = make_environment(task, cfg, states, device=device)
    made = time.perf_counter() - begun
    actions = 0.5 * torch.randn(16, cfg.worlds, environment.num_actions, device=environment.device)
    count = 0

    def step() -> None:
        nonlocal count
        environment.step(actions[count % len(actions)])
        count += 1

    with torch.inference_mode():
        environment.reset()
        one = seconds(step, args.steps, args.repeats, device)
        log = environment.read_log()
        parts = dict(zip(PARTS, environment.parts(), strict=True))
        profile = {name: seconds(part, args.steps, 1, device) for name, part in parts.items()}
        environment.reset()
        physics = seconds(bare(environment, cfg.decimation, device), args.steps, args.repeats, device)
    result = {
        "collision": cfg.collision,
        "spheres": int(task.collidable.sum()),
        "worlds": cfg.worlds,
        "decimation": cfg.decimation,
        "bare_per_second": cfg.worlds / physics,
        "environment_per_second": cfg.worlds / one,
        "share": physics / one,
        "overflow": log["overflow"],
        "diverged": log["diverged worlds"],
        "made_seconds": made,
        "profile_ms": {name: 1e3 * value for name, value in profile.items()},
    }
    if args.ppo:
        environment.reset()
        trainer = Trainer(environment, TrainCfg(environment=cfg, ppo=PpoCfg(iterations=2 + args.repeats)))
        trainer.learn()
        rounds = trainer.history[2:]
        best = min(rounds, key=lambda this: this.collecting + this.updating)
        result |= {
            "ppo_per_second": cfg.worlds * trainer.cfg.ppo.steps / (best.collecting + best.updating),
            "updating_share": best.updating / (best.collecting + best.updating),
        }
    if device.startswith("cuda"):
        free, total = torch.cuda.mem_get_info()
        result["memory_gib"] = (total - free) / 2**30
    return result


def page(data: dict[str, Any]) -> str:
    """Return the page of the stored results."""
    about = (__doc__ or "").split("\n\n", 2)[2].strip()
    parts = ["# Throughput of training", f"Written by `benchmarks/{NAME}.py`; do not edit.", about]
    for result in data.values():
        head = [
            "spheres, worlds",
            "bare",
            "environment",
            "share",
            "with PPO",
            "of it updating",
            "contacts dropped",
            "GiB",
        ]
        rows, profile = [], []
        for r in result["rows"]:
            name = f"{r['spheres']} ({r['collision']}), {r['worlds']:,}"
            ppo = [f"{r['ppo_per_second']:,.0f}", f"{r['updating_share']:.0%}"] if "ppo_per_second" in r else ["", ""]
            memory = f"{r['memory_gib']:.1f}" if "memory_gib" in r else ""
            rate = [f"{r['bare_per_second']:,.0f}", f"{r['environment_per_second']:,.0f}", f"{r['share']:.1%}"]
            rows.append([name, *rate, *ppo, f"{r['overflow']:.2%} of steps", memory])
            profile.append([name, *(f"{r['profile_ms'][part]:.2f}" for part in PARTS)])
        steps = result["rows"][0]["decimation"]
        parts += [
            f"## {result['machine'].get('device', 'CPU')}",
            machine_line(result["machine"]),
            f"Environment steps per second, of {steps} simulation steps each:",
            table(head, rows),
            "Where a step's time goes [ms]:",
            table(["spheres, worlds", *PARTS], profile),
        ]
    return "\n\n".join(parts)


def main() -> None:
    """Measure and report."""
    args = tyro.cli(Args, description=__doc__)
    if not args.table:
        quiet_warp()
        made = make_run(args.spheres)
        counts = args.worlds or ((256, 1024, 4096, 8192, 16384, 32768) if args.device.startswith("cuda") else (8,))
        rows = []
        for collision in args.collisions:
            cfg = replace(args.cfg, collision=collision)
            task = Task.build(made.model, made.recording[0], cfg, made.events)
            states = draw_states(task, cfg.reset, 0, count=args.states)
            for worlds in counts:
                rows.append(measure(task, states, replace(cfg, worlds=worlds), args))
                print(rows[-1], flush=True)
                kind = "cuda" if args.device.startswith("cuda") else "cpu"
                write_data(NAME, read_data(NAME) | {kind: {"machine": machine(args.device), "rows": rows}})
    write_page(NAME, page(read_data(NAME)))


if __name__ == "__main__":
    main()
