"""One training on one GPU and on several: environment steps per second, and how it learns.

    python -m benchmarks.train.gpus --out F --gpus 1 2        # insertion of the shape sorter, F a .jsonl
    python -m benchmarks.train.gpus --report F                # the page, from what was measured

Of each number of GPUs there are two trainings a seed: with as many worlds in all as on one GPU, which is to learn the
same in fewer seconds a step, and with as many on each. Each is a run of ``concent train`` under torchrun; start and
compilation are left out of its seconds.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Literal

import tyro

from benchmarks.measurements import Measurements, Row
from benchmarks.pages import machine, machine_line, read_data, table, write_data, write_page
from concent_warp.model import Model
from concent_warp.reality.record import RealityCfg, record
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.train.learning.metrics import read_curve

NAME = "train_gpus"
MARKS = (0.25, 0.5, 0.9)
"""Shares of successful episodes, while exploring, whose first time is reported."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    out: Path | None = None
    """File of the measurements (.jsonl); what is in it is not measured again."""
    report: Path | None = None
    """File of measurements to take into the page."""
    gpus: tuple[int, ...] = (1, 2)
    """Numbers of processes, each with a GPU."""
    device: Literal["cuda", "cpu"] = "cuda"
    worlds: int = 4096
    """Worlds on one GPU."""
    iterations: int = 40
    seeds: tuple[int, ...] = (0,)
    spheres: int = 512
    seconds: float | None = None
    """Time after which no training is begun [s]."""
    options: tuple[str, ...] = ()
    """Further options of concent train, as in `--options=--ppo.steps 4`, each as one argument."""


def material(folder: Path, spheres: int) -> list[str]:
    """Write recording and model, and return them as arguments of ``concent train``."""
    recording, _ = record(RealityCfg(), [0])
    scene = Scene(recording.scene)
    write_hdf5(recording, folder / "demo.h5")
    Model(scene, ContactGeometryCfg(count=spheres).build(scene)).save(folder / "model.toml")
    return [str(folder / "demo.h5"), "--model", str(folder / "model.toml")]


def trained(args: Args, given: list[str], folder: Path, gpus: int, worlds: int, seed: int) -> Row:
    """Train once and return its curve and its rate."""
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", str(gpus), "-m", "concent_warp"]
    command += ["train", *given, "--out", str(folder), "--overwrite", "--device", args.device, "--seed", str(seed)]
    command += ["--worlds", str(worlds), "--iterations", str(args.iterations)]
    command += [part for option in args.options for part in option.split()]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    subprocess.run(command, env=environment, check=True)
    curve = [(point["steps"], point["seconds"], point["success"]) for point in read_curve(folder)]
    late = curve[len(curve) // 2 :]
    first, last = late[0], late[-1]
    rate = (last[0] - first[0]) / (last[1] - first[1]) if len(late) > 1 else curve[-1][0] / curve[-1][1]
    row = {"gpus": gpus, "worlds": worlds, "seed": seed, "steps_per_second": rate, "curve": curve}
    return {**row, "options": " ".join(args.options)}


def measure(args: Args, out: Path) -> None:
    """Train what is wanted."""
    kept = Measurements(out, seconds=args.seconds)
    facts = machine(args.device)
    with tempfile.TemporaryDirectory() as place:
        given = material(Path(place), args.spheres)
        for seed in args.seeds:
            for gpus in args.gpus:
                for worlds in dict.fromkeys((args.worlds // gpus, args.worlds)):
                    if kept.wanted(key := f"{gpus} x {worlds}, seed {seed}"):
                        kept.add(
                            key, {"machine": facts, **trained(args, given, Path(place) / "run", gpus, worlds, seed)}
                        )
    kept.close()


def first(row: Row, mark: float) -> tuple[int, float] | None:
    """Return steps and seconds after which a share of the episodes succeeded, None where it never did."""
    return next(((steps, seconds) for steps, seconds, success in row["curve"] if success >= mark), None)


def reached(rows: Sequence[Row], mark: float) -> str:
    """Return when trainings reached a share of success, as a table shows it: medians of those that did."""
    ends = [end for row in rows if (end := first(row, mark)) is not None]
    if not ends:
        return "-"
    some = f" ({len(ends)} of {len(rows)})" if len(ends) < len(rows) else ""
    return f"{median(end[0] for end in ends) / 1e6:.2f} M, {median(end[1] for end in ends):.0f} s{some}"


def page(rows: list[Row]) -> str:
    """Return the page."""
    groups: dict[tuple[int, int], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["gpus"], row["worlds"]), []).append(row)
    base = [median(r["steps_per_second"] for r in group) for (gpus, _), group in groups.items() if gpus == 1]
    lines = []
    for (gpus, worlds), group in sorted(groups.items()):
        rate = median(row["steps_per_second"] for row in group)
        last = median(row["curve"][-1][2] for row in group)
        gain = f"{rate / base[0]:.2f}" if base else "-"
        times = [reached(group, mark) for mark in MARKS]
        lines.append([f"{gpus} x {worlds:,}", f"{rate:,.0f}", gain, str(len(group)), *times, f"{last:.1%}"])
    options = " and ".join(sorted({f"`{row['options']}`" for row in rows if row["options"]})) or "default settings"
    marks = [f"{mark:.0%} after" for mark in MARKS]
    head = ["GPUs x worlds", "steps/s", "of one", "seeds", *marks, "in the end"]
    return f"""# Training on several GPUs

Insertion stage of the shape sorter with the arm, `concent train` under torchrun, {options}; each GPU has
the given number of worlds. Steps are those of all GPUs; rates are those of the second half of the training, with
learning. Seconds leave out start and compilation. Success is that of the episodes of an iteration, while exploring;
medians over the seeds. One seed each does not show how learning differs between numbers of GPUs.

{table(head, lines)}
{machine_line(rows[0]["machine"])} Made by `python -m benchmarks.train.gpus --out F`, then `--report F`.
"""


def main() -> None:
    """Measure or report."""
    args = tyro.cli(Args, description=__doc__)
    if args.out is not None:
        measure(args, args.out)
    if args.report is not None:
        write_data(NAME, {"rows": list(Measurements(args.report).rows.values())})
    if args.out is None:
        write_page(NAME, page(read_data(NAME)["rows"]))


if __name__ == "__main__":
    main()
