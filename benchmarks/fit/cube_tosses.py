"""Fits of a sphere cube, 5 % too small or too large, to measured tosses of a cube.

The data are the ContactNets cube tosses (Pfrommer, Halm, Posa, CoRL 2020; 275 of them). For each of several random
splits the fit sees 40 tosses and starts from a cube of spheres that is 5 % too small, then from one 5 % too large; all
other tosses judge it. Nothing of the true size is in the model that is fitted: its box is scaled as well.

    python -m benchmarks.fit.cube_tosses --data ../shared/data/contactnets_cube      # writes into docs/benchmarks
    python -m benchmarks.fit.cube_tosses --quick --out /tmp/cube                       # one small split, seconds

The spheres' positions alone are fitted first, then positions and friction; contact parameters and gravity never are.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from datetime import date
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from scipy import stats

from benchmarks.fit.cube_tosses_data import Judge, free_fall, resting_height, rests_at, sphere_cube, standing_widths
from benchmarks.fit.cube_tosses_report import write_report
from concent_warp.fit.fit_geometry import FitCfg, fit_geometry
from concent_warp.fit.geometry.evolution import EvolutionCfg
from concent_warp.recording.formats.contactnets import EDGE, FRICTION, read_contactnets

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data" / "contactnets_cube"
FACTORS = (0.95, 1.05)
RESAMPLES = 10_000
FRICTION_SIGMA = 0.2
"""Standard deviation of the logarithm of a sphere's friction in the first generation, where friction is fitted."""

FIT = FitCfg(
    evolution=EvolutionCfg(
        population=16,
        sigma=3e-4,
        swelling=5.0,
        swelling_length=0.2,
        flat_start=False,
        flattening=0.0,
        length=0.05,
    ),
    generations=25,
    plateau_generations=25,
    window=0.1,
    batch=60,
)
"""The doubt is about the size of a rigid convex object: so candidates differ mostly by swelling (1.5 mm, which is a
fraction of the 2.6 mm that a side is off), by nearly the same amount all over the cube (twice its edge) and with faces
that stay flat; dents (0.3 mm) reach over half an edge, where the default of 30 mm suits objects of 40 mm. Windows of
0.1 s, because a tumbling cube hits the board every 50-100 ms; 60 of about 200 windows a generation."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    data: Path = DATA
    """Folder of the tosses, one .pt each."""
    out: Path = ROOT / "docs" / "benchmarks"
    """Folder of fit_cube_tosses.md and data/fit_cube_tosses.json and .png."""
    splits: int = 3
    """Random splits, seeds 0, 1, ..."""
    fitted: int = 40
    """Tosses that a fit sees."""
    judged: int | None = None
    """Tosses that judge it; None takes all others."""
    limit: int | None = None
    """Tosses to read, in the order of their numbers; None reads all."""
    friction: tuple[bool, ...] = (False, True)
    """Fit the positions of the spheres alone, and their friction too."""
    workers: int = len(os.sched_getaffinity(0))
    """Fits at a time."""
    quick: bool = False
    """One split of 10 tosses to fit and 10 to judge, few generations: shows that it runs, the figures mean little."""


@dataclass(frozen=True)
class Task:
    """One fit."""

    seed: int
    """Of the split and of the search."""
    factor: float
    """Edge of the start, relative to the published one."""
    friction: bool
    """Whether friction is fitted too."""


def split(names: list[str], args: Args, seed: int) -> tuple[list[str], list[str]]:
    """Return the names of the tosses to fit and of those to judge."""
    chosen = [names[i] for i in np.random.default_rng(seed).permutation(len(names))]
    end = None if args.judged is None else args.fitted + args.judged
    return chosen[: args.fitted], chosen[args.fitted : end]


def paired(before: np.ndarray, after: np.ndarray) -> dict[str, float]:
    """Compare the errors of the same tosses (n,) before and after: means, fall with its bootstrap interval, tests."""
    known = np.isfinite(before) & np.isfinite(after)
    before, after = before[known], after[known]
    rows = np.random.default_rng(0).integers(0, len(before), (RESAMPLES, len(before)))
    falls = 1 - after[rows].mean(axis=1) / before[rows].mean(axis=1)
    return {
        "tosses": len(before),
        "before": float(before.mean()),
        "after": float(after.mean()),
        "fall": float(1 - after.mean() / before.mean()),
        "fall_low": float(np.percentile(falls, 2.5)),
        "fall_high": float(np.percentile(falls, 97.5)),
        "improved": float((after < before).mean()),
        "wilcoxon_p": p_value(stats.wilcoxon(before, after)),
        "t_p": p_value(stats.ttest_rel(before, after)),
    }


def p_value(result: Any) -> float:
    """Return the p-value of a test of SciPy."""
    return float(result.pvalue)


class Bench:
    """What all fits share: the tosses, how to judge, and the errors of the cubes that are not fitted."""

    def __init__(self, args: Args, cfg: FitCfg) -> None:
        """Read the tosses, and judge the cubes of wrong and of published size on all of them."""
        assert cfg.window is not None
        self.args, self.cfg = args, cfg
        self.recording = read_contactnets(args.data, limit=args.limit)
        self.names = [d.name for d in self.recording.demonstrations]
        self.judge = Judge(self.recording, cfg.window)
        self.factors = (*FACTORS, 1.0)
        cubes = [sphere_cube(self.recording, factor * EDGE) for factor in self.factors]
        self.unfitted = self.judge([cube.geometry for cube in cubes if cube.geometry is not None], self.names)

    def run(self, task: Task) -> dict[str, Any]:
        """Fit from one wrong size and judge; errors in m and rad."""
        fit, others = split(self.names, self.args, task.seed)
        evolution = replace(self.cfg.evolution, fit_friction=task.friction, friction_sigma=FRICTION_SIGMA)
        cfg = replace(self.cfg, seed=task.seed, evolution=evolution)
        start = sphere_cube(self.recording, task.factor * EDGE)
        clock, cpu = time.perf_counter(), time.process_time()
        found = fit_geometry(start, self.recording, cfg, demonstrations=fit, engine="mujoco")
        seconds = {"wall": time.perf_counter() - clock, "cpu": time.process_time() - cpu}
        fitted = found.model.geometry
        assert fitted is not None
        columns = [self.names.index(name) for name in others]
        after, unfitted = asdict(self.judge([fitted], others)), asdict(self.unfitted)
        before, true = (self.factors.index(factor) for factor in (task.factor, 1.0))
        result: dict[str, Any] = {**asdict(task), "seconds": seconds, "generations": len(found.history)}
        result |= {"simulations": found.history[-1]["simulations"], "fitted_names": fit, "judged_names": others}
        result["start_edge"], result["edge"] = task.factor * EDGE, float(standing_widths(fitted).mean())
        result["widths"], result["rests_at"] = standing_widths(fitted).tolist(), rests_at(found.model)
        result["sphere_friction"] = np.percentile(fitted.friction, [10, 50, 90]).tolist()
        for name, errors in unfitted.items():
            test = paired(errors[before, columns], after[name][0])
            result[name] = test | {"true_size": float(np.nanmean(errors[true, columns]))}
        result["tosses"] = {
            "before": unfitted["window"][before, columns].tolist(),
            "after": after["window"][0].tolist(),
        }
        return result


def run_all(bench: Bench, tasks: list[Task]) -> list[dict[str, Any]]:
    """Run the fits, several at a time: each simulates on its own, and Python would hold threads up."""
    results = []
    if bench.args.workers == 1:
        for task in tasks:
            results.append(bench.run(task))
            print(progress(results[-1]), flush=True)
        return results
    with ProcessPoolExecutor(bench.args.workers, mp_context=get_context("spawn")) as pool:
        for result in pool.map(partial(Bench.run, bench), tasks):
            results.append(result)
            print(progress(result), flush=True)
    return results


def measure(args: Args, cfg: FitCfg) -> dict[str, Any]:
    """Run everything."""
    clock = time.perf_counter()
    bench = Bench(args, cfg)
    starts = [(seed, factor) for seed in range(args.splits) for factor in FACTORS]
    results = run_all(bench, [Task(*start, friction) for friction in args.friction for start in starts])
    seen = sorted({name for found in results for name in found["fitted_names"]})
    gravity, gravity_error = free_fall(bench.recording, seen)
    return {
        "date": date.today().isoformat(),
        "machine": {"cpu": cpu_name(), "cores": cores(), "python": platform.python_version()},
        "command": "python benchmarks/" + " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "quick": args.quick,
        "tosses": len(bench.names),
        "fit": asdict(cfg),
        "edge": EDGE,
        "friction": FRICTION,
        "resting_edge": 2 * resting_height(bench.recording, seen),
        "free_fall": gravity,
        "free_fall_error": gravity_error,
        "seconds": time.perf_counter() - clock,
        "results": results,
    }


def progress(found: dict[str, Any]) -> str:
    """Return one line about a fit."""
    before, after, true = (1e3 * found["window"][name] for name in ("before", "after", "true_size"))
    friction = ", friction too" if found["friction"] else ""
    return (
        f"split {found['seed']}, start {1e3 * found['start_edge']:.1f} mm{friction}: {before:.2f} -> {after:.2f} mm"
        f" (true size {true:.2f}), edge {1e3 * found['edge']:.1f} mm, {found['seconds']['wall']:.0f} s"
    )


def cpu_name() -> str:
    """Return the name of the processor."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def cores() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0))


def main(args: Args) -> dict[str, Any]:
    """Measure, and write the page, its data and its figure; returns the data."""
    if not args.data.is_dir():
        sys.exit(
            f"{args.data}: no folder of tosses. Get the cube tosses of ContactNets (.pt files of (T, 13) tensors) and"
            " name their folder with --data."
        )
    cfg = FIT
    if args.quick:
        args = replace(args, splits=1, fitted=10, judged=10, limit=24, friction=(False,), workers=1)
        cfg = replace(FIT, evolution=replace(FIT.evolution, population=8), generations=6, batch=16)
    document = measure(args, cfg)
    folder = args.out / "data"
    folder.mkdir(parents=True, exist_ok=True)
    unfinished = folder / ".fit_cube_tosses.json.partial"
    unfinished.write_text(json.dumps(document) + "\n")
    unfinished.replace(folder / "fit_cube_tosses.json")
    write_report(document, args.out)
    return document


if __name__ == "__main__":
    main(tyro.cli(Args))
