"""Evolution strategy, gradients, and gradients that seed the strategy: error against simulations and time.

Four scenes (settle, push, tumble, insertion), five seeds each. The error is the mean distance of 24 tracked points
between measurement and model, in C MuJoCo, on the fitted demonstration and on an unseen one; evaluating it costs no
simulations. A rollout in MuJoCo counts as one simulation, one in Newton with its gradient as two.

    python -m benchmarks.fit.es_vs_gradient --out runs/es_vs_gradient.jsonl  # resumable; --seconds 200 ends early
    python -m benchmarks.fit.es_vs_gradient --out runs/es_vs_gradient.jsonl --report   # page and figure, in docs

Several processes may share the work by --seeds and --scenes, each with its own --out; --parts names the others to
the report. The page keeps the results of other machines, in docs/benchmarks/data.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from benchmarks.fit.gradient_scenes import SCENES, SceneName, record, starting_model
from benchmarks.measurements import Measurements
from benchmarks.pages import FOLDER, machine, machine_line, read_data, table, write_data, write_page
from concent_warp.estimation.object_tracks import whole_demonstration
from concent_warp.fit.fit_geometry import FitCfg, cut_segments, warm_start
from concent_warp.fit.geometry.evolution import EvolutionCfg
from concent_warp.fit.geometry.objective import Objective
from concent_warp.fit.geometry.search import Search
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.select import EngineName

NAME = "es_vs_gradient"
MethodName = Literal["es", "gradient+es"]
METHODS: tuple[MethodName, ...] = ("es", "gradient+es")
FIT = FitCfg(
    evolution=EvolutionCfg(population=16, length=0.02, freeze_gripped=False, sigma_decay=0.96),
    generations=40,
    plateau_generations=40,
)
"""Nothing is grasped in these scenes: a pushing body must not freeze the face that it touches."""
SLACK = 1.05
"""An error within this factor of another counts as equal."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    out: Path = Path("runs") / f"{NAME}.jsonl"
    scenes: tuple[SceneName, ...] = SCENES
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    methods: tuple[MethodName, ...] = METHODS
    fit: FitCfg = FIT
    engine: EngineName = "mujoco"
    device: str = "cpu"
    """Where Newton runs; MuJoCo runs where `engine` does."""
    seconds: float | None = None
    """No fit is begun after so long."""
    report: bool = False
    """Write the page from what was measured."""
    parts: tuple[Path, ...] = ()
    """More files of results that the report takes in."""


def judge(model: Model, recording: Recording) -> list[float]:
    """Return the mean distance of tracked points from where a model has them, by demonstration [mm]."""
    engine, result = MujocoEngine(model, threads=1), []
    assert model.geometry is not None
    for demonstration in recording.demonstrations:
        segment = whole_demonstration(model.scene, demonstration, model.geometry.bodies)
        objective = Objective(engine, [segment], held_out=0.0, block=0.2)
        rollout = engine.run(variants_of(segment), objective.ctrl, record=objective.record, bodies=objective.bodies)
        target = segment.targets[0]
        lower, weight = objective.rows(target.time, objective.record, objective.ctrl.shape[1])
        position, quaternion = rollout.body_position[0, :, 0], rollout.body_quaternion[0, :, 0]
        predicted = carried(position, quaternion, target.anchor)
        between = predicted[lower] + weight[:, None, None] * (predicted[lower + 1] - predicted[lower])
        result.append(float(np.nanmean(np.linalg.norm(between - target.points, axis=2)) * 1e3))
    return result


def variants_of(segment: Any) -> Any:
    """Return the one variant that starts where a segment does."""
    from concent_warp.simulate.engine import Variants

    return Variants(1, qpos=segment.qpos[None], qvel=segment.qvel[None])


def carried(position: np.ndarray, quaternion: np.ndarray, anchor: np.ndarray) -> np.ndarray:
    """Return points of a body (M, 3) [m] where poses (R, 3), (R, 4) wxyz have them, shape (R, M, 3)."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    return position[:, None] + np.einsum("rij,mj->rmi", turn, anchor)


def run(args: Args, scene: SceneName, seed: int, method: MethodName) -> dict[str, Any]:
    """Run one fit and judge its estimate after each generation."""
    recording = record(scene, seed)
    model = starting_model(scene, recording, seed)
    cfg = replace(args.fit, seed=seed, gradient=replace(args.fit.gradient, device=args.device))
    shown = [recording["demo_0"]]
    curve: list[dict[str, float]] = []
    judging = 0.0

    def note(search: Search, error: list[float], simulations: int) -> None:
        seconds = time.perf_counter() - begun - judging
        curve.append({"simulations": simulations, "seconds": seconds, "fitted": error[0], "unseen": error[1]})
        curve[-1]["loss_mm"] = 1e3 * min(search.best, 1e3)

    start = judge(model, recording)
    begun = time.perf_counter()
    search = Search(model, cut_segments(model, shown, cfg), cfg, args.engine)
    row: dict[str, Any] = {"scene": scene, "seed": seed, "method": method, "start": start}
    if method == "gradient+es":
        warm_start(search, "gradient+es", shown, cfg.gradient, None, False, None)
        found = search.gradients
        assert found is not None
        row |= {"helped": found.helped, "remark": found.remark}
        at = time.perf_counter()
        error = judge(model.with_geometry(search.evolution.geometry(found.mean)), recording)
        judging += time.perf_counter() - at
        note(search, error, search.simulations)
    while search.stopped is None:
        search.step()
        at = time.perf_counter()
        error = judge(search.result().model, recording)
        judging += time.perf_counter() - at
        note(search, error, search.simulations)
    return {**row, "curve": curve, "machine": machine(args.device)}


def measure(args: Args) -> None:
    """Run what is missing."""
    kept = Measurements(args.out, seconds=args.seconds)
    short = replace(args.fit, generations=1, gradient=replace(args.fit.gradient, iterations=1))
    warm = False
    for seed in args.seeds:
        for scene in args.scenes:
            for method in args.methods:
                key = f"{scene} {seed} {method} {args.device}"
                if kept.wanted(key, 20.0):
                    if not warm:  # kernels are compiled at their first use, which is not to be timed
                        run(replace(args, fit=short), "settle", 0, "gradient+es")
                        warm = True
                    kept.add(key, run(args, scene, seed, method))
    kept.close()


def reached(curve: list[dict[str, float]], error: float, which: str) -> float:
    """Return the simulations after which a curve lies at or below an error for the first time; infinite if never."""
    return next((p["simulations"] for p in curve if p[which] <= error), np.inf)


def at_budget(curve: list[dict[str, float]], simulations: float, which: str) -> float:
    """Return the error of the last point of a curve within a budget; that of the first where none is."""
    within = [p[which] for p in curve if p["simulations"] <= simulations]
    return within[-1] if within else curve[0][which]


def summary(rows: dict[str, dict[str, Any]], scene: str, device: str) -> list[str] | None:
    """Return the table row of a scene: medians over seeds."""
    pairs = []
    for seed in sorted({r["seed"] for r in rows.values()}):
        both = [rows.get(f"{scene} {seed} {method} {device}") for method in METHODS]
        if all(both):
            pairs.append(both)
    if not pairs:
        return None
    es, mixed = [p[0] for p in pairs], [p[1] for p in pairs]
    final = [r["curve"][-1] for r in es]
    share = [
        reached(m["curve"], SLACK * e["curve"][-1]["fitted"], "fitted") / e["curve"][-1]["simulations"]
        for e, m in pairs
    ]
    equal = [at_budget(m["curve"], f["simulations"], "fitted") for m, f in zip(mixed, final, strict=True)]

    alike = [reached(e["curve"], SLACK * m["curve"][0]["fitted"], "fitted") for e, m in pairs]

    def text(values: list[float]) -> str:
        return f"{np.median(values):.2f} ({min(values):.2f}-{max(values):.2f})"

    ratio = [a / b["fitted"] for a, b in zip(equal, final, strict=True)]
    return [
        scene,
        str(len(pairs)),
        f"{sum(m['helped'] for m in mixed)}",
        text([r["start"][0] for r in es]),
        text([r["curve"][0]["fitted"] for r in mixed]),
        text([f["fitted"] for f in final]),
        text(equal),
        text(ratio),
        text([f["unseen"] for f in final]),
        text([r["curve"][-1]["unseen"] for r in mixed]),
        f"{np.median([f['simulations'] for f in final]):.0f}",
        f"{np.median([r['curve'][0]['simulations'] for r in mixed]):.0f}",
        f"{np.median(alike):.0f}" if np.isfinite(np.median(alike)) else "not reached",
        f"{np.median(share):.2f}" if np.isfinite(np.median(share)) else "not reached",
        f"{sum(s <= 1 / 3 for s in share)} of {len(share)}",
        f"{np.median([f['seconds'] for f in final]):.0f}",
        f"{np.median([r['curve'][0]['seconds'] for r in mixed]):.0f}",
    ]


def report(args: Args) -> None:
    """Write the page."""
    fresh = {key: row for path in (args.out, *args.parts) for key, row in Measurements(path).rows.items()}
    known = read_data(NAME)
    if not fresh and not known:
        raise SystemExit(f"{args.out}: no results; run without --report first")
    rows = known.get("rows", {}) | fresh
    devices = sorted({key.rsplit(" ", 1)[1] for key in rows})
    assert __doc__ is not None
    text = ["# Evolution strategy, gradients, and both", "", "\n".join(__doc__.split("\n")[2:6]).strip(), ""]
    text += [
        "`python -m benchmarks.fit.es_vs_gradient`. Medians over seeds (range); errors in mm.",
        "",
        "- *gradient*: the last iterate of the descent, evaluated in MuJoCo. *helped*: seeds in which it is at",
        "  least 5 % better than the start; the evolution strategy then begins there, else at the start.",
        "- *at equal budget*: gradient+es after as many simulations as es takes in all; *ratio*: relative to es.",
        "- *of es to the error of gradient*: simulations after which es is within 5 % of that error.",
        "- *share*: simulations until gradient+es is within 5 % of the final error of es, relative to those of es;",
        "  *a third*: seeds in which it is at most a third.",
        "",
    ]
    head = [
        "scene", "seeds", "helped", "start", "gradient", "es", "gradient+es at equal budget", "ratio", "es, unseen",
        "gradient+es, unseen", "simulations of es", "of gradient", "of es to the error of gradient", "share", "a third",
        "seconds of es", "of gradient",
    ]  # fmt: skip
    machines = known.get("machines", {}) | {key.rsplit(" ", 1)[1]: row["machine"] for key, row in fresh.items()}
    for device in devices:
        found = [s for scene in SCENES if (s := summary(rows, scene, device)) is not None]
        text += [machine_line(machines[device]), "", table(head, found)]
        draw(rows, device, FOLDER / f"{NAME}_{device.split(':')[0]}.png")
        text += [f"![Error against simulations and time]({NAME}_{device.split(':')[0]}.png)", ""]
    plain = {key: {k: v for k, v in row.items() if k != "machine"} for key, row in rows.items()}
    write_data(NAME, {"machines": machines, "rows": plain})
    page = FOLDER / f"{NAME}.md"
    said = page.read_text().split("## Reading the figures", 1)[1:] if page.is_file() else []
    text += [f"## Reading the figures{part}" for part in said]
    write_page(NAME, "\n".join(text))


def draw(rows: dict[str, dict[str, Any]], device: str, path: Path) -> None:
    """Draw the error against simulations and against time, one thin line a seed, the median thick."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(SCENES), figsize=(3.2 * len(SCENES), 5.4), layout="constrained")
    for column, scene in enumerate(SCENES):
        for line, axis in enumerate(("simulations", "seconds")):
            ax = axes[line, column]
            for method, colour in zip(METHODS, ("#0b6e99", "#d9730d"), strict=True):
                curves = [
                    [{axis: 0.0, "fitted": r["start"][0]}, *r["curve"]]
                    for key, r in rows.items()
                    if key.startswith(f"{scene} ") and key.endswith(f" {method} {device}")
                ]
                for curve in curves:
                    ax.plot([p[axis] for p in curve], [p["fitted"] for p in curve], color=colour, alpha=0.3, lw=0.8)
                if curves:
                    grid = np.linspace(0, max(c[-1][axis] for c in curves), 60)
                    steps = [[at(c, axis, x) for x in grid] for c in curves]
                    ax.plot(grid, np.median(steps, axis=0), color=colour, lw=2, label=method)
            ax.set_yscale("log")
            ax.set_xlabel(axis if axis == "simulations" else "time [s]")
            ax.spines[["top", "right"]].set_visible(False)
            if line == 0:
                ax.set_title(scene, fontsize=10)
    axes[0, 0].set_ylabel("error [mm]")
    axes[1, 0].set_ylabel("error [mm]")
    named = [ax for ax in axes.flat if ax.get_legend_handles_labels()[0]]
    if named:
        named[0].legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def at(curve: list[dict[str, float]], axis: str, x: float) -> float:
    """Return the error of the last point of a curve at or before x."""
    return [p["fitted"] for p in curve if p[axis] <= x][-1]


if __name__ == "__main__":
    arguments = tyro.cli(Args)
    if arguments.report:
        report(arguments)
    else:
        measure(arguments)
