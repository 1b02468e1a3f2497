"""Steps per second of `WarpEngine.run` beside those of bare MuJoCo-Warp on the same model.

    python -m benchmarks.kernels.engine --device cuda:0 --output docs/benchmarks/data/engine_h200.json
    python -m benchmarks.kernels.engine --table        # the page from the stored results

The work is one generation of the evolution strategy: a demonstration of the shape sorter, replayed by many worlds with
different spheres. *bare* is `mujoco_warp.step` captured in a graph and launched once a step, with copies of the
commands in between. *engine* is all of `WarpEngine.run` with existing graphs: geometry and commands loaded, worlds
reset, every step checked for overflow and instability, records at 30 Hz, results copied out. Neither includes
compilation and capture, which are in *first run*. *mujoco* is `MujocoEngine` on all CPUs. Other scenes are not
measured: time per step grows with spheres and contacts.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from datetime import date
from pathlib import Path
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from benchmarks.pages import FOLDER, table, write_page
from concent_warp.files import write_text
from concent_warp.model import Model
from concent_warp.reality.record import RealityCfg, record
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.simulate.engine import Contacts, Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.replay import commands, initial_state, step_count
from concent_warp.simulate.warp_engine import WarpEngine

RECORD_RATE = 30.0
"""Records a second of simulated time [Hz]."""
NOISE = 2e-4
"""Standard deviation of the sphere centres between worlds [m]."""


class Work:
    """A demonstration to replay with other spheres in each world."""

    def __init__(self, spheres: int, duration: float | None) -> None:
        recording, _ = record(RealityCfg(), [0])
        demonstration = recording.demonstrations[0]
        scene = Scene(recording.scene)
        self.model = Model(scene, ContactGeometryCfg(count=spheres).build(scene))
        compiled = scene.model
        self.steps = step_count(demonstration, compiled.opt.timestep, duration)
        self.ctrl = commands(compiled, demonstration, self.steps)
        self.qpos, self.qvel = initial_state(compiled, demonstration)
        self.record = np.arange(0, self.steps + 1, round(1 / RECORD_RATE / compiled.opt.timestep))

    def variants(self, worlds: int, seed: int) -> Variants:
        """Return worlds that start as the demonstration did and whose spheres differ."""
        assert self.model.geometry is not None
        position = self.model.geometry.position
        return Variants(
            worlds,
            sphere_position=position + np.random.default_rng(seed).normal(0, NOISE, (worlds, *position.shape)),
            qpos=np.tile(self.qpos, (worlds, 1)),
            qvel=np.tile(self.qvel, (worlds, 1)),
        )


def engine_seconds(work: Work, engine: WarpEngine | MujocoEngine, worlds: int, contacts: Contacts, seed: int) -> float:
    """Return the time of one run [s]."""
    variants = work.variants(worlds, seed)
    start = time.perf_counter()
    engine.run(variants, work.ctrl, record=work.record, bodies=["block"], contacts=contacts)
    if isinstance(engine, WarpEngine):
        wp.synchronize_device(engine.device)
    return time.perf_counter() - start


def bare_seconds(work: Work, engine: WarpEngine, worlds: int, repeats: int) -> float:
    """Return the shortest time of all steps of bare MuJoCo-Warp, with the engine's buffer sizes [s]."""
    buffers, compiled = engine.buffers, engine.compiled
    assert buffers is not None
    variants = work.variants(worlds, 0)
    with wp.ScopedDevice(engine.device):
        m = mjw.put_model(compiled, batch_sizes={"geom_pos": worlds})
        m.opt.warn_overflow = 0
        places = m.geom_pos.numpy()
        places[:, engine.sphere_geom] = variants.sphere_position
        m.geom_pos.assign(places)
        d = mjw.make_data(compiled, nworld=worlds, nconmax=buffers.contacts, njmax=buffers.constraints)
        ctrl = [wp.array(np.tile(row, (worlds, 1)), dtype=float) for row in work.ctrl]
        mjw.step(m, d)
        with wp.ScopedCapture() as captured:
            mjw.step(m, d)
        graph = captured.graph
        assert graph is not None
        times = []
        for _ in range(repeats):
            mjw.reset_data(m, d)
            d.qpos.assign(variants.qpos)
            d.qvel.assign(variants.qvel)
            wp.synchronize()
            start = time.perf_counter()
            for k in range(work.steps):
                wp.copy(d.ctrl, ctrl[k])
                wp.capture_launch(graph)
            wp.synchronize()
            times.append(time.perf_counter() - start)
    return min(times)


def measure(work: Work, device: str, worlds: int, repeats: int) -> dict[str, float | int | str]:
    """Return the figures of one number of worlds."""
    engine = WarpEngine(work.model, device=device)
    first = engine_seconds(work, engine, worlds, "none", 0)
    growths = engine.repeats
    steps = worlds * work.steps
    plain = min(engine_seconds(work, engine, worlds, "none", seed) for seed in range(repeats))
    engine_seconds(work, engine, worlds, "touched", 0)
    touched = min(engine_seconds(work, engine, worlds, "touched", seed) for seed in range(repeats))
    bare = bare_seconds(work, engine, worlds, repeats)
    assert engine.buffers is not None
    return {
        "worlds": worlds,
        "steps": work.steps,
        "bare_steps_per_second": steps / bare,
        "engine_steps_per_second": steps / plain,
        "engine_share_of_bare": bare / plain,
        "engine_with_touched_share_of_bare": bare / touched,
        "first_run_seconds": first,
        "growths_in_first_run": growths,
        "nconmax": engine.buffers.contacts,
        "njmax": engine.buffers.constraints,
        "solver_limited_worlds": engine.limited,
    }


def section(result: dict[str, Any]) -> str:
    """Return what was measured on one device."""
    rows = [
        [
            f"{r['worlds']:,}",
            f"{r['bare_steps_per_second']:,.0f}",
            f"{r['engine_steps_per_second']:,.0f}",
            f"{r['engine_share_of_bare']:.1%}",
            f"{r['engine_with_touched_share_of_bare']:.1%}",
            f"{r['first_run_seconds']:.1f}",
        ]
        for r in result["warp"]
    ]
    head = [
        "worlds",
        "bare, steps/s",
        "engine, steps/s",
        "engine / bare",
        "with contacts by sphere / bare",
        "first run, s",
    ]
    versions = ", ".join(f"{name} {number}" for name, number in result["versions"].items())
    steps, limited = result["warp"][0]["steps"], sum(r["solver_limited_worlds"] for r in result["warp"])
    text = f"""## {result["device"]}

Measured {result["date"]} with {versions}. {result["spheres"]} spheres, {steps:,} steps a run, the fastest run counts.
Worlds in which the solver reached its limit of iterations: {limited}.

{table(head, rows)}"""
    if mujoco_rate := result.get("mujoco_steps_per_second"):
        best = max(r["engine_steps_per_second"] for r in result["warp"])
        text += f"""
C MuJoCo on the {result["cpus"]} CPU cores of the same machine: {mujoco_rate:,.0f} steps/s. The engine's best rate is
{best / mujoco_rate:.1f} times that.
"""
    return text


def page() -> str:
    """Return the page of all stored results."""
    results = [json.loads(path.read_text()) for path in sorted((FOLDER / "data").glob("engine_*.json"))]
    about = (__doc__ or "").split("\n\n", 2)[2].strip()
    return "\n\n".join(
        ["# Engine", "Written by `benchmarks/kernels/engine.py`; do not edit.", about, *map(section, results)]
    )


def main() -> None:
    """Measure and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda:0" if wp.is_cuda_available() else "cpu", help="Warp's device")
    parser.add_argument("--worlds", type=int, nargs="+", default=[256, 1024, 4096], help="numbers of worlds")
    parser.add_argument("--spheres", type=int, default=512, help="spheres of both objects together")
    parser.add_argument("--duration", type=float, help="seconds of the demonstration to replay; all by default")
    parser.add_argument("--repeats", type=int, default=3, help="runs of which the fastest counts")
    parser.add_argument("--mujoco-worlds", type=int, default=8, help="variants for C MuJoCo; 0 leaves it out")
    parser.add_argument("--output", type=Path, help="JSON file to write")
    parser.add_argument("--table", action="store_true", help="write the page from the stored results, without runs")
    args = parser.parse_args()
    if args.table:
        write_page("engine", page())
        return

    work = Work(args.spheres, args.duration)
    rows = []
    for worlds in args.worlds:
        rows.append(measure(work, args.device, worlds, args.repeats))
        print(json.dumps(rows[-1]), flush=True)
    result = {
        "device": str(wp.get_device(args.device).name),
        "processor": platform.processor() or platform.machine(),
        "cpus": len(os.sched_getaffinity(0)),
        "versions": {"mujoco": mujoco.__version__, "mujoco_warp": mjw.__version__, "warp": wp.__version__},
        "date": date.today().isoformat(),
        "spheres": args.spheres,
        "repeats": args.repeats,
        "warp": rows,
    }
    if args.mujoco_worlds:
        engine = MujocoEngine(work.model)
        seconds = min(engine_seconds(work, engine, args.mujoco_worlds, "none", s) for s in range(args.repeats))
        result["mujoco_steps_per_second"] = args.mujoco_worlds * work.steps / seconds
        print(json.dumps({"mujoco_steps_per_second": result["mujoco_steps_per_second"]}))
    if args.output is not None:
        write_text(args.output, json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
