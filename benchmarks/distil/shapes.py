"""What a student makes of the shapes that it is shown: episodes in Reality's physics, seen by four kinds of cameras.

    python -m benchmarks.distil.shapes runs/student      # trials that are not measured yet, for the page of students

Reality's cameras show objects with cut edges, the model draws them sharp. Each kind of cameras shows either, so that
whatever else differs between Reality's images and simulated ones is told from the shapes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
import tyro

import concent_warp as cw
from benchmarks.distil.student import SHAPES
from benchmarks.measurements import Measurements, Row
from benchmarks.pages import machine
from concent_warp.cli.terminal import quiet_warp
from concent_warp.deploy.evaluate import reality_environment, reality_world
from concent_warp.deploy.reality_images import RealityImages
from concent_warp.deploy.simulated_images import simulated_images
from concent_warp.train.distil.student import Student
from concent_warp.train.trials.evaluate import run_episodes

CUT = 0.0015
"""Width of the cuts along the edges of Reality's block [m]."""
KINDS = (
    "Reality's images",
    "Reality's images, sharp edges",
    "simulated images, sharp edges",
    "simulated images, edges cut by 1.5 mm",
)


@dataclass(frozen=True)
class Args:
    """Command line."""

    student: tyro.conf.Positional[Path]
    """Run folder of a student."""
    name: Annotated[str, tyro.conf.arg(aliases=["-n"])] = "student"
    """What the student is called in the rows."""
    kinds: tuple[int, ...] = (0, 1, 2, 3)
    """Which of the four kinds of cameras."""
    episodes: int = 16
    """Episodes of a trial."""
    seed: int = 2
    """Seed of initial states, worlds and looks."""
    data: Path = SHAPES
    """File of the rows."""


def trial(student: Student, kind: str, episodes: int, seed: int) -> Row:
    """Return the outcomes of episodes in Reality's physics under one of `KINDS` of cameras."""
    begun, cfg, run = time.monotonic(), cw.EvaluateCfg(), student.run
    task = run.task()
    states = run.evaluation_states(task, episodes, seed)
    settings = replace(run.cfg.environment, worlds=episodes)
    torch.manual_seed(seed)
    environment = reality_environment(task, settings, states, cfg, seed=seed)
    if kind.startswith("Reality"):
        sharp = task.model.scene.spec()
        world = sharp if "sharp" in kind else reality_world(task, settings, cfg).spec()
        images = RealityImages(environment, world, student.cfg.images, cfg.cameras, seed=seed)
        act = student.act_in(environment, images, delay=(0, 0))
    else:
        width = CUT if "cut" in kind else 0.0
        looks = replace(student.cfg.looks, size=0.0, chamfer=(width, width))
        act = student.act_in(environment, simulated_images(environment, student.cfg.images, looks))
    found = run_episodes(environment, act, states)
    row: Row = {"kind": kind, "seed": seed, "episodes": episodes, "successes": int(found.success.sum())}
    return row | {"outcomes": found.counts(), "seconds": time.monotonic() - begun}


def main() -> None:
    """Measure what is not measured yet."""
    args = tyro.cli(Args, description=__doc__)
    quiet_warp()
    student, kept = cw.load_student(args.student), Measurements(args.data)
    for kind in (KINDS[k] for k in args.kinds):
        key = f"{args.name} {args.seed} {kind}"
        if kept.wanted(key):
            found = trial(student, kind, args.episodes, args.seed)
            kept.add(key, {"name": args.name, "machine": machine("cpu"), **found})
    kept.close()


if __name__ == "__main__":
    main()
