"""Forward and backward runs through Newton: worlds x steps a second, and memory, for 1 to 1,024 worlds.

A box of 64 spheres that settles on a plane, 0.2 s. One rollout with its gradient is timed, captured and warm; the
backward pass includes a second simulation of each chunk of steps. *bytes a step*: memory of one step of one world until
its gradient is computed; *per chunk*: that of all worlds and all steps of a chunk; *on the device*: GPU memory after
the first call, point clouds included. Other scenes need more time with more pairs of spheres.

    python -m benchmarks.fit.gradient_throughput --out runs/gradient_throughput.jsonl                  # on a CPU
    python -m benchmarks.fit.gradient_throughput --out runs/gradient_throughput.jsonl --device cuda:0  # appended
    python -m benchmarks.fit.gradient_throughput --out runs/gradient_throughput.jsonl --report         # page, in docs

The page keeps the results of other machines, in docs/benchmarks/data.
"""

from __future__ import annotations

import gc
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.fit.gradient_scenes import record, starting_model
from benchmarks.measurements import Measurements
from benchmarks.pages import FOLDER, machine, machine_line, read_data, table, write_data, write_page
from concent_warp.estimation.object_tracks import whole_demonstration
from concent_warp.fit.newton.horizon import shortened
from concent_warp.fit.newton.loss import NewtonLoss
from concent_warp.fit.newton.scene import newton_scene
from concent_warp.fit.newton.worlds import Parameters

NAME = "gradient_throughput"


@dataclass(frozen=True)
class Args:
    """Command line."""

    out: Path = Path("runs") / f"{NAME}.jsonl"
    worlds: tuple[int, ...] = (1, 4, 16, 64, 256, 1024)
    device: str = "cpu"
    repeats: int = 3
    limit: float = 60.0
    """No more worlds are tried once the timed rollouts of a measurement have taken so long [s]."""
    seconds: float | None = None
    """No measurement is begun after so long."""
    report: bool = False
    """Write the page from what was measured."""


def measure(worlds: int, device: str, repeats: int) -> dict[str, Any]:
    """Time rollouts with gradients of so many worlds."""
    import warp as wp

    recording = record("settle", 0)
    model = starting_model("settle", recording, 0)
    assert model.geometry is not None
    segment = whole_demonstration(model.scene, recording["demo_0"], model.geometry.bodies)
    scene = newton_scene(model, [shortened(model.scene.model, segment, 0.2)])
    gc.collect()
    before = taken(device)
    loss = NewtonLoss(scene, worlds, device=device)
    parameters = Parameters(np.repeat(model.geometry.position[None], worlds, axis=0))
    begun = time.perf_counter()
    loss(parameters)
    wp.synchronize()
    first = time.perf_counter() - begun
    held = None if device == "cpu" else taken(device) - before
    times, forward = [], []
    for _ in range(repeats):
        begun = time.perf_counter()
        loss(parameters)
        wp.synchronize()
        times.append(time.perf_counter() - begun)
        begun = time.perf_counter()
        loss.losses(parameters)
        wp.synchronize()
        forward.append(time.perf_counter() - begun)
    return {
        "worlds": worlds,
        "steps": scene.steps,
        "pairs": len(scene.pairs),
        "chunk": loss.worlds.chunk,
        "first": first,
        "seconds": float(np.median(times)),
        "forward_seconds": float(np.median(forward)),
        "bytes": loss.worlds.memory / worlds,
        "held": held,
        "machine": machine(device),
    }


def taken(device: str) -> int:
    """Return the memory of a graphics processor that Warp and PyTorch have taken [bytes], 0 on a CPU."""
    import torch
    import warp as wp

    if device == "cpu":
        return 0
    return wp.get_mempool_used_mem_current(device) + torch.cuda.memory_allocated(device)


def main(args: Args) -> None:
    """Measure what is missing, or write the page."""
    kept = Measurements(args.out, seconds=args.seconds)
    if args.report:
        report(read_data(NAME) | kept.rows)
        return
    for worlds in args.worlds:
        key = f"{args.device} {worlds}"
        if kept.wanted(key):
            row = measure(worlds, args.device, args.repeats)
            kept.add(key, row)
            # The first call is not counted: it compiles the kernels where nothing has yet.
            if args.repeats * (row["seconds"] + row["forward_seconds"]) > args.limit:
                break
    kept.close()


def report(rows: dict[str, dict[str, Any]]) -> None:
    """Write the page, and the data that the next one starts from."""
    if not rows:
        raise SystemExit("no results; run without --report first")
    assert __doc__ is not None
    text = ["# Throughput of gradients through Newton", "", "\n".join(__doc__.split("\n")[2:6]), ""]
    text += ["`python -m benchmarks.fit.gradient_throughput`.", ""]
    head = [
        "worlds", "steps", "pairs", "forward and backward, world steps/s", "forward alone", "bytes a step",
        "per chunk [MB]", "on the device [MB]", "first call [s]",
    ]  # fmt: skip
    for device in sorted({key.split(" ")[0] for key in rows}):
        mine = sorted((r for key, r in rows.items() if key.startswith(f"{device} ")), key=lambda r: r["worlds"])
        lines = []
        for r in mine:
            work = r["worlds"] * r["steps"]
            lines.append(
                [
                    f"{r['worlds']:,}", f"{r['steps']:,}", str(r["pairs"]), f"{work / r['seconds']:,.0f}",
                    f"{work / r['forward_seconds']:,.0f}", f"{r['bytes']:,.0f}",
                    f"{r['bytes'] * r['worlds'] * r['chunk'] / 1e6:,.0f}",
                    f"{r['held'] / 1e6:,.0f}" if r.get("held") is not None else "-", f"{r['first']:.1f}",
                ]
            )  # fmt: skip
        text += [machine_line(mine[0]["machine"]), "", table(head, lines)]
    write_data(NAME, rows)
    page = FOLDER / f"{NAME}.md"
    said = page.read_text().split("## Reading the figures", 1)[1:] if page.is_file() else []
    write_page(NAME, "\n".join([*text, *(f"## Reading the figures{part}" for part in said)]))


if __name__ == "__main__":
    main(tyro.cli(Args))
