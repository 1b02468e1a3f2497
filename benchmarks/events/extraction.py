"""Contact events on demonstrations of the shape sorter: stages found, their times, and repeatability.

python -m benchmarks.events.extraction                                       # the inset geometry, 12 seeds
python -m benchmarks.events.extraction --model runs/demo/model.toml --name fitted
python -m benchmarks.events.extraction --table                               # the page from the stored results
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import tyro

from benchmarks.pages import machine, machine_line, read_data, table, write_data, write_page
from concent_warp.events.extract_events import extract_events
from concent_warp.events.overlap import overlap
from concent_warp.events.sequence import ContactEventSequence, Stage
from concent_warp.ground import contact_overlap
from concent_warp.model import Model
from concent_warp.reality.record import RealityCfg, Truth, record
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.load import load_recording
from concent_warp.recording.recording import Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.replay import replay

NAME = "events"
STAGES = ("pick", "align", "insert")
UPRIGHT = 0.5
"""The normal of a wall of the hole is less vertical than this; that of the rim and of its edges is more."""
SUNK = 0.002
"""Depth below the rim at which the motion of model and truth are compared [m]."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    seeds: tuple[int, ...] = tuple(range(12))
    """One demonstration each."""
    warp_seeds: tuple[int, ...] = (0, 1)
    """Those of the seeds on which the engines are compared; MuJoCo-Warp is slow on a CPU."""
    repeats: int = 5
    """Extractions in this process, and as many in processes of their own."""
    model: Path | None = None
    """Fitted model; by default the inset geometry as it is laid."""
    name: str = "inset"
    """Name of the model on the page."""
    table: bool = False
    """Write the page from the stored results, without runs."""


def true_starts(cfg: RealityCfg, scene: Scene, truth: Truth) -> dict[str, float]:
    """Return when the stages truly began [s]: the first contact of a finger and the block, of block and box, and of
    the block with a wall of the hole, identified by the normal of the contact in the exact geometry.
    """
    fingers = [
        touching for pair, touching in truth.contacts.items() if "block" in pair and any("finger" in b for b in pair)
    ]
    box = truth.contacts["block", "box"]
    found = {"pick": truth.time[np.logical_or.reduce(fingers).argmax()], "align": truth.time[box.argmax()]}
    world = cfg.world.build(scene).compile()
    data = mujoco.MjData(world)
    block, wall = world.body("block").id, world.body("box").id
    for step in np.flatnonzero(box):
        data.qpos[:] = truth.qpos[step]
        mujoco.mj_kinematics(world, data)
        mujoco.mj_collision(world, data)
        bodies = np.sort(world.geom_bodyid[data.contact.geom], axis=1)
        pair = (bodies == sorted((block, wall))).all(axis=1)
        level = np.abs(data.contact.frame[:, 2]) < UPRIGHT
        if (pair & level & (data.contact.dist < 0)).any():
            found["insert"] = truth.time[step]
            break
    return {name: round(float(time), 4) for name, time in found.items()}


def sunk(cfg: RealityCfg, time: np.ndarray, height: np.ndarray, after: float) -> float | None:
    """Return when the block has sunk into the hole by `SUNK` [s]; None if it does not.

    Args:
        cfg: Says how high the block's origin is while it rests on the rim.
        time: Times [s], shape (T,).
        height: Height of the block's origin [m], shape (T,).
        after: When the block came to the box [s].
    """
    below = (time >= after) & (height < cfg.task.box_height + cfg.task.block_size / 2 - SUNK)
    return round(float(time[below.argmax()]), 4) if below.any() else None


def bodies_of(sequence: ContactEventSequence, stage: Stage) -> list[list[str]]:
    """Return the pairs of links and objects of a target event, by body, sorted."""
    body = {name: entity.body for name, entity in sequence.entity.items()}
    return [list(pair) for pair in sorted({(body[pair.a], body[pair.b]) for pair in stage.event.pairs})]


def digest(events: dict[str, ContactEventSequence]) -> list[str]:
    """Return a digest of the file of each sequence."""
    return [hashlib.sha256(sequence.to_json().encode()).hexdigest() for sequence in events.values()]


def repeated(model: Model, recording: Recording, args: Args) -> dict[str, Any]:
    """Extract again and again, here and in processes of their own, save and load, and count what differs."""
    first = extract_events(model, recording)
    reference = digest(first)
    here = [digest(extract_events(model, recording)) for _ in range(args.repeats)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_hdf5(recording, folder / "demo.h5")
        model.save(folder / "model.toml")
        apart = []
        for k in range(args.repeats):
            command = ["events", "demo.h5", "--model", "model.toml", "--out", str(k)]
            environment = {**os.environ, "PYTHONHASHSEED": str(k)}
            subprocess.run(
                [sys.executable, "-m", "concent_warp", *command],
                cwd=folder,
                env=environment,
                check=True,
                stdout=subprocess.DEVNULL,
            )
            files = [folder / str(k) / f"events_{demonstration}.json" for demonstration in first]
            apart.append([hashlib.sha256(file.read_bytes()).hexdigest() for file in files])
        loaded = {}
        for demonstration, sequence in first.items():
            sequence.save(folder / "events.json")
            loaded[demonstration] = ContactEventSequence.load(folder / "events.json")
    return {
        "sequences": len(reference),
        "here": len(here),
        "processes": len(apart),
        "same_bytes": sum(len(set(each)) == 1 for each in zip(reference, *here, *apart, strict=True)),
        "loaded_equal": sum(loaded[name] == first[name] for name in first),
        "loaded_same_bytes": sum(map(str.__eq__, reference, digest(loaded))),
    }


def engines(model: Model, recording: Recording, seed: int) -> dict[str, Any]:
    """Compare the sequences of the two engines on one demonstration."""
    one, other = (next(iter(extract_events(model, recording, engine=engine).values())) for engine in ("mujoco", "warp"))
    found = overlap(one, other)
    stages = [[stage.name for stage in sequence.stages] for sequence in (one, other)]
    both = list(zip(one.stages, other.stages, strict=False))
    return {
        "seed": seed,
        "same_stages": stages[0] == stages[1],
        "same_pairs": all(bodies_of(one, a) == bodies_of(other, b) for a, b in both),
        "same_links": all(a.event.links == b.event.links for a, b in both),
        "spheres": found.primitives,
        "frames": found.frames.pooled,
        "apart": {a.name: round(b.start - a.start, 6) for a, b in both},
    }


def sinking(cfg: RealityCfg, model: Model, demonstration: Demonstration, truth: Truth) -> list[float | None]:
    """Return when the block sinks into the hole [s] in the model's replay and in truth."""
    rollout = replay(model, demonstration, MujocoEngine(model), bodies=("block",))
    met = float(truth.time[truth.contacts["block", "box"].argmax()])
    motions = ((rollout.time, rollout.body_position[0, :, 0, 2]), (truth.time, truth.block_position[:, 2]))
    return [sunk(cfg, time, height, met) for time, height in motions]


def measure(args: Args) -> dict[str, Any]:
    """Return the results of one model."""
    cfg = RealityCfg()
    recording, truths = record(cfg, list(args.seeds))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "demo.h5"
        write_hdf5(recording, file)
        recording = load_recording(file)
    scene = Scene(recording.scene)
    model = Model(scene, ContactGeometryCfg().build(scene)) if args.model is None else Model.load(args.model)
    events = extract_events(model, recording)
    names = list(events)
    frames = contact_overlap(
        events, {n: (t.time, t.contacts) for n, t in zip(names, truths, strict=True)}, scene.objects()
    )
    rows = [
        {
            "seed": seed,
            "stages": [stage.name for stage in events[name].stages],
            "start": {stage.name: stage.start for stage in events[name].stages},
            "truth": true_starts(cfg, scene, truth),
            "sunk": sinking(cfg, model, recording[name], truth),
            "frames": frames[name],
            "success": truth.success,
        }
        for seed, name, truth in zip(args.seeds, names, truths, strict=True)
    ]
    compared = [args.seeds.index(seed) for seed in args.warp_seeds if seed in args.seeds]
    return {
        "machine": machine(),
        "rows": rows,
        "repeats": repeated(model, recording, args),
        "engines": [engines(model, recording.only((names[i],)), args.seeds[i]) for i in compared],
    }


def differences(late: list[float]) -> list[str]:
    """Return the mean and the largest size of differences in time [s], in ms."""
    return [f"{1e3 * size:.0f}" for size in (np.abs(late).mean(), np.abs(late).max())]


def section(name: str, result: dict[str, Any]) -> str:
    """Return the section of one model."""
    rows = result["rows"]
    right = sum(tuple(row["stages"]) == STAGES for row in rows)
    text = f"## {name[0].upper()}{name[1:]} geometry\n\n{machine_line(result['machine'])}\n\n"
    text += f"Exactly {', '.join(STAGES)}, in this order, on {right} of {len(rows)} seeds.\n\n"
    cells = []
    for row in rows:
        pairs = [(row["start"].get(stage), row["truth"].get(stage)) for stage in STAGES]
        times = ["-" if a is None or b is None else f"{a:.3f} ({1e3 * (a - b):+.0f} ms)" for a, b in pairs]
        cells.append([str(row["seed"]), ", ".join(row["stages"]), *times, f"{row['frames']:.2f}"])
    text += table(["seed", "stages", *(f"{stage} [s]" for stage in STAGES), "contact overlap"], cells) + "\n"
    off = {
        f"start of {stage}": [
            r["start"][stage] - r["truth"][stage] for r in rows if stage in r["start"] and stage in r["truth"]
        ]
        for stage in STAGES
    }
    off["block 2 mm below the rim"] = [r["sunk"][0] - r["sunk"][1] for r in rows if None not in r["sunk"]]
    cells = [
        [what, str(len(late)), f"{1e3 * np.mean(late):+.0f}", *differences(late)] for what, late in off.items() if late
    ]
    head = ["model against truth", "seeds", "mean late [ms]", "mean difference [ms]", "largest difference [ms]"]
    text += table(head, cells) + "\n"
    again = result["repeats"]
    repeats = f"{again['here'] + again['processes']} repeats, {again['processes']} in processes of their own"
    counts = {
        f"same bytes in {repeats}": again["same_bytes"],
        "equal after saving and loading": again["loaded_equal"],
        "same bytes when saved again": again["loaded_same_bytes"],
    }
    cells = [[what, f"{count} of {again['sequences']}"] for what, count in counts.items()]
    text += table(["repeats", "sequences"], cells) + "\n"
    if result["engines"]:
        text += "**Engines.** C MuJoCo against MuJoCo-Warp (on the CPU):\n\n"
        cells = [
            [
                str(e["seed"]),
                *("yes" if e[key] else "no" for key in ("same_stages", "same_links", "same_pairs")),
                *(f"{e['spheres'].get(stage, 0):.2f}" for stage in STAGES),
                f"{e['frames']:.3f}",
                f"{1e3 * max((abs(t) for t in e['apart'].values()), default=0):.0f}",
            ]
            for e in result["engines"]
        ]
        head = [
            "seed",
            "same stages",
            "same links",
            "same link/object pairs",
            *(f"spheres of {s}, IoU" for s in STAGES),
        ]
        text += table([*head, "contact frames, IoU", "stages apart by at most [ms]"], cells) + "\n"
    return text


def page(results: dict[str, Any]) -> str:
    """Return the page."""
    text = """# Contact events: shape sorter

`python -m benchmarks.events.extraction`: demonstrations of Reality, one a seed, replayed in a model; the [contact
events](../events.md) of the replay are compared with Reality's contacts. In brackets: by how much a stage starts later
than in Reality, where pick starts with the first contact of a finger and the block, align with that of block and box,
insert with that of the block and a wall of the hole. The model steps by 5 ms, Reality by 1 ms. *Contact overlap*: IoU
of the frames in which block and box touch with those of Reality.

What the figures do not show: how exactly stages are found in insert. There the replayed motion itself differs: the
block slips off the rim earlier or later, depending on the geometry (row *block 2 mm below the rim*), and in Reality as
in the model it then rests in the mouth of the hole, 2 to 4 mm deep, where it may or may not touch a wall. With a hole
that is too wide in the model, no align exists.

"""
    return text + "\n".join(section(name, result) for name, result in results.items())


def main(args: Args) -> None:
    """Measure and write data and page."""
    results = read_data(NAME)
    if not args.table:
        results[args.name] = measure(args)
        write_data(NAME, results)
    write_page(NAME, page(results))


if __name__ == "__main__":
    main(tyro.cli(Args))
