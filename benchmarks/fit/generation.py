"""Speed of the evolution strategy: a generation against bare MuJoCo-Warp, and the time from recording to converged fit.

    python -m benchmarks.fit.generation                           # 1,024 candidates on CUDA, 8 on a CPU
    python -m benchmarks.fit.generation --converge                # whole fits, population by population
    python -m benchmarks.fit.generation --table                   # the page from the stored results

A *generation* samples candidates of the contact geometry, replays the whole demonstration with all of them together,
compares point clouds by the Chamfer distance, and updates the estimate. *bare* is `mujoco_warp.step` captured in a
graph and launched once a step, with the same model, collidable spheres, candidates and buffer sizes, and copies of the
commands in between. Neither includes compilation and capture. They alternate; the share is the median over neighbours.
Before each generation a fit replays its estimate once in C MuJoCo to find the spheres in contact: *survey* is that
time. Other scenes and numbers of spheres are not measured.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco_warp as mjw
import numpy as np
import tyro
import warp as wp

from benchmarks.fit.shape_sorter import Start, judge, starting_geometry
from benchmarks.pages import machine, machine_line, read_data, table, write_data, write_page
from concent_warp.cli.terminal import quiet_warp
from concent_warp.fit.fit_geometry import FitCfg, cut_segments
from concent_warp.fit.geometry.search import Search
from concent_warp.model import Model
from concent_warp.reality.record import RealityCfg, Truth, record
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.load import load_recording
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene
from concent_warp.simulate.warp_engine import WarpEngine, preferred_device

NAME = "fit_generation"
BOUND = 0.8
"""Share of the bare engine's speed that a generation is to reach on a GPU."""
SETTLED = 1.05
"""A fit has converged once its best loss is within this factor of where it ends."""
PARTS = ("ask", "simulate", "compare", "tell")
SHOWN = ("loss_mm", "error_mm", "unseen_mm", "contact_overlap")


@dataclass(frozen=True)
class Args:
    """Command line."""

    device: str = field(default_factory=preferred_device)
    """Warp's device; the first CUDA device where there is one."""
    populations: tuple[int, ...] = ()
    """Candidates; by default 1,024 on CUDA and 8 on a CPU, and 64 to 4,096 for whole fits."""
    repeats: int = 5
    """Generations, each beside a bare run."""
    start: Start = "surface"
    """Starting geometry."""
    fit: FitCfg = field(default_factory=FitCfg)
    """Settings of the fit; its population is replaced."""
    duration: float | None = None
    """Seconds of the demonstration; all by default."""
    converge: bool = False
    """Measure whole fits."""
    table: bool = False
    """Write the page from the stored results, without runs."""


class Bare:
    """MuJoCo-Warp's own step on the model of an engine, with the engine's buffer sizes."""

    def __init__(self, engine: WarpEngine, ctrl: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, worlds: int) -> None:
        """Capture a step.

        Args:
            engine: An engine that has run.
            ctrl: Commands, shape (K, nu).
            qpos: Initial state, shape (nq,).
            qvel: Initial velocity, shape (nv,).
            worlds: Number of worlds.
        """
        assert engine.buffers is not None
        self.device, self.worlds = engine.device, worlds
        self.qpos, self.qvel = np.tile(qpos, (worlds, 1)), np.tile(qvel, (worlds, 1))
        self.collidable = engine.sphere_geom >= 0
        self.geoms = engine.sphere_geom[self.collidable]
        with wp.ScopedDevice(self.device):
            self.model = mjw.put_model(engine.compiled, batch_sizes={"geom_pos": worlds})
            self.model.opt.warn_overflow = 0
            self.data = mjw.make_data(
                engine.compiled, nworld=worlds, nconmax=engine.buffers.contacts, njmax=engine.buffers.constraints
            )
            self.ctrl = [wp.array(np.tile(row, (worlds, 1)), dtype=float) for row in ctrl]
            mjw.step(self.model, self.data)
            with wp.ScopedCapture() as captured:
                mjw.step(self.model, self.data)
        self.graph = captured.graph

    def seconds(self, position: np.ndarray) -> float:
        """Return the time of all steps [s] with sphere centres (N, S, 3) [m]."""
        m, d = self.model, self.data
        assert self.graph is not None
        with wp.ScopedDevice(self.device):
            places = m.geom_pos.numpy()
            places[:, self.geoms] = position[:, self.collidable]
            m.geom_pos.assign(places)
            mjw.reset_data(m, d)
            d.qpos.assign(self.qpos)
            d.qvel.assign(self.qvel)
            wp.synchronize()
            begun = time.perf_counter()
            for row in self.ctrl:
                wp.copy(d.ctrl, row)
                wp.capture_launch(self.graph)
            wp.synchronize()
            return time.perf_counter() - begun


UNSEEN = (1, 2)
"""Seeds of the demonstrations that judge a fit to that of seed 0."""


def demonstration() -> tuple[Recording, Recording, list[Truth]]:
    """Return a demonstration as it is read from its file, it and two others of the same objects, and what truly
    happened in all three.
    """
    recording, truths = record(RealityCfg(), [0, *UNSEEN])
    with tempfile.TemporaryDirectory() as folder:
        write_hdf5(recording, Path(folder) / "demo.h5")
        found = load_recording(Path(folder) / "demo.h5")
    return found.only((next(d.name for d in found.demonstrations),)), found, truths


def search_of(args: Args, recording: Recording, population: int) -> Search:
    """Return a search that is about to begin."""
    scene = Scene(recording.scene)
    model = Model(scene, starting_geometry(scene, args.start, 0))
    cfg = replace(args.fit, evolution=replace(args.fit.evolution, population=population))
    search = Search(model, cut_segments(model, recording.demonstrations, cfg), cfg, "warp")
    if args.duration is not None:
        steps = round(args.duration / model.scene.model.opt.timestep)
        search.used = [replace(segment, ctrl=segment.ctrl[:steps]) for segment in search.used]
    return search


def generation(search: Search, mask: np.ndarray, engine: WarpEngine) -> tuple[dict[str, float], np.ndarray]:
    """Run one generation as `Search.step` does; return the time of its parts [s] and the candidates (P, S, 3) [m]."""
    marks = [time.perf_counter()]
    values = search.evolution.ask(mask, search.rng)
    candidates = search.evolution.candidates(values)
    objective = search.objective(engine, search.jittered(search.used))
    marks.append(time.perf_counter())
    rollout = objective.simulate(candidates)
    marks.append(time.perf_counter())
    losses = objective.losses(rollout, len(values))
    marks.append(time.perf_counter())
    search.evolution.tell(values, losses.fit, mask)
    marks.append(time.perf_counter())
    return dict(zip(PARTS, np.diff(marks).tolist(), strict=True)), candidates.position


def measure_generation(args: Args, recording: Recording, population: int) -> dict[str, Any]:
    """Return the figures of one population."""
    search = search_of(args, recording, population)
    begun = time.perf_counter()
    found = search.survey(search.used)
    mask, reachable, loss = found.mask, found.reachable, found.loss
    survey = time.perf_counter() - begun
    search.evolution.scale_to(loss)
    collidable = reachable | mask
    engine = WarpEngine(search.model, collidable=collidable, device=args.device)
    generation(search, mask, engine)
    (segment,) = search.used
    bare = Bare(engine, segment.ctrl, segment.qpos, segment.qvel, population)
    parts, times, growths = [], [], 0
    for _ in range(args.repeats):
        found, position = generation(search, mask, engine)
        growths += engine.repeats
        parts.append(found)
        times.append(bare.seconds(position))
    steps = population * len(segment.ctrl)
    whole = np.array([sum(found.values()) for found in parts])
    assert engine.buffers is not None
    return {
        "population": population,
        "steps": len(segment.ctrl),
        "spheres": int(collidable.size),
        "collidable": int(collidable.sum()),
        "moving": int(mask.sum()),
        "nconmax": engine.buffers.contacts,
        "njmax": engine.buffers.constraints,
        "generation_steps_per_second": spread(steps / whole),
        "bare_steps_per_second": spread(steps / np.array(times)),
        "share": spread(np.array(times) / whole),
        "share_with_survey": spread(np.array(times) / (whole + survey)),
        "seconds": {part: float(np.median([found[part] for found in parts])) for part in PARTS},
        "survey_seconds": survey,
        "growths": growths,
    }


def spread(values: np.ndarray) -> dict[str, float]:
    """Return median, smallest and largest of some values (n,)."""
    return {"median": float(np.median(values)), "low": float(values.min()), "high": float(values.max())}


def measure_fit(
    args: Args, recording: Recording, every: Recording, truths: list[Truth], population: int
) -> dict[str, Any]:
    """Fit from the file to the end and return how long that took and what error is left."""
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        write_hdf5(recording, Path(folder) / "demo.h5")
        begun = time.perf_counter()
        recording = load_recording(Path(folder) / "demo.h5")
    search = search_of(args, recording, population)
    search.engine_name = "warp" if args.device != "cpu" else "mujoco"
    history = []
    while search.stopped is None:
        search.step()
        history.append((time.perf_counter() - begun, search.best))
        print(f"population {population}: {history[-1][0]:.1f} s, best {1e3 * search.best:.3f} mm", flush=True)
    best = search.result().model
    settled = next(at for at, value in history if value <= SETTLED * search.best)
    judged = [
        [judge(model, d, truth) for d, truth in zip(every.demonstrations, truths, strict=True)]
        for model in (search.model, best)
    ]
    before, after = (found[0] for found in judged)
    return {
        "population": population,
        "generations": len(history),
        "simulations": search.simulations,
        "engine": search.engine_name,
        "seconds": history[-1][0],
        "seconds_to_settle": settled,
        "stopped": search.stopped,
        "loss_mm": [1e3 * search.history[0]["loss"], 1e3 * search.best],
        "error_mm": [before["mean"], after["mean"]],
        "unseen_mm": [float(np.mean([found["mean"] for found in each[1:]])) for each in judged],
        "contact_overlap": [before["frames"], after["frames"]],
        "history": [[round(at, 3), round(1e3 * value, 4)] for at, value in history],
    }


def populations(args: Args) -> Sequence[int]:
    """Return the populations to measure."""
    cuda = args.device != "cpu"
    if args.populations:
        return args.populations
    if args.converge:
        return (64, 256, 1024, 4096) if cuda else (16,)
    return (1024,) if cuda else (8,)


def measure(args: Args) -> Iterator[dict[str, Any]]:
    """Measure what was asked for, of one device; yield the results with each population that is done."""
    recording, every, truths = demonstration()
    rows = []
    for population in populations(args):
        if args.converge:
            rows.append(measure_fit(args, recording, every, truths, population))
        else:
            rows.append(measure_generation(args, recording, population))
        print({key: value for key, value in rows[-1].items() if key != "history"}, flush=True)
        yield {"machine": machine(args.device), "start": args.start, "rows": rows}


def number(found: dict[str, float], digits: int = 0) -> str:
    """Return a median with its range."""
    return f"{found['median']:,.{digits}f} ({found['low']:,.{digits}f}-{found['high']:,.{digits}f})"


def generation_table(rows: list[dict[str, Any]]) -> str:
    """Return the table of generations."""
    cells = []
    for row in rows:
        parts = [f"{row['seconds'][part]:.3f}" for part in PARTS]
        speeds = [number(row[f"{name}_steps_per_second"]) for name in ("generation", "bare")]
        cells.append(
            [
                f"{row['population']:,}",
                f"{row['collidable']} of {row['spheres']}",
                *speeds,
                number(row["share"], 2),
                *parts,
                f"{row['survey_seconds']:.2f}",
                number(row["share_with_survey"], 2),
            ]
        )
    head = ["candidates", "collidable spheres", "generation, steps/s", "bare, steps/s", "share", *PARTS]
    return table([*head, "survey", "share with survey"], cells)


def fit_table(rows: list[dict[str, Any]]) -> str:
    """Return the table of whole fits."""
    cells = [
        [
            f"{row['population']:,}",
            row["engine"],
            str(row["generations"]),
            f"{row['seconds']:.1f}",
            f"{row['seconds_to_settle']:.1f}",
            *(" -> ".join(f"{value:.2f}" for value in row[key]) for key in SHOWN),
        ]
        for row in rows
    ]
    head = ["candidates", "engine", "generations", "seconds to the end", "seconds to converge"]
    return table(
        [*head, "Chamfer distance [mm]", "block position error [mm]", "on unseen [mm]", "contact overlap"], cells
    )


def page(results: dict[str, Any]) -> str:
    """Return the page."""
    text = f"# Speed of the fit\n\n{(__doc__ or '').split(chr(10) * 2, 2)[2].strip()}\n\n"
    text += "`python -m benchmarks.fit.generation`. Median (range) over generations; times of parts in seconds.\n\n"
    for kind, title in (("generation", "A generation"), ("fit", "From recording to converged fit")):
        text += f"## {title}\n\n"
        if kind == "generation":
            text += f"Bound on a GPU: a share of {BOUND:.0%} with 1,024 candidates.\n\n"
        else:
            text += (
                "Time from the recording's file; the first fit on a machine compiles for about half a minute more.\n"
            )
            text += f"Converged: the best Chamfer distance is within {SETTLED - 1:.0%} of the last one.\n\n"
        found = {key: value for key, value in results.items() if key.startswith(kind)}
        for result in found.values():
            text += (
                f"{machine_line(result['machine'])} Start: {result['start']}. {result.get('note', '')}".rstrip()
                + "\n\n"
            )
            text += (generation_table if kind == "generation" else fit_table)(result["rows"]) + "\n"
        if not any("device" in result["machine"] for result in found.values()):
            text += "Not measured on a GPU yet.\n\n"
    return text


def main(args: Args) -> None:
    """Measure and write data and page."""
    results = read_data(NAME)
    if not args.table:
        kind = "fit" if args.converge else "generation"
        for found in measure(args):
            results[f"{kind}_{'cpu' if args.device == 'cpu' else 'cuda'}"] = found
            write_data(NAME, results)
    write_page(NAME, page(results))


if __name__ == "__main__":
    quiet_warp()
    main(tyro.cli(Args))
