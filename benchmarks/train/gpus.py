"""One training on one GPU and on several: environment steps per second, memory, and how it learns.

    python -m benchmarks.train.gpus --out F --gpus 1 2 4      # insertion of the shape sorter, F a .jsonl
    python -m benchmarks.train.gpus --report F [F ...]        # page and plot, from what was measured

The worlds on each GPU are as many as on one; with ``--strong`` there are also trainings with as many in all as on one
GPU. Each is a run of ``concent train`` under torchrun, with the default settings and with faster physics; start and
compilation are left out of its seconds, and so is the stress test, which is the same work on any number of GPUs.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import median
from typing import Literal

import matplotlib.pyplot as plt
import tyro

from benchmarks.measurements import Measurements, Row
from benchmarks.pages import FOLDER, machine, machine_line, read_data, table, write_data, write_page
from concent_warp.model import Model
from concent_warp.reality.record import RealityCfg, record
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.train.learning.metrics import read_curve

NAME = "train_gpus"
MARKS = (0.5, 0.9, 0.99)
"""Shares of successful episodes, while exploring, whose first time is reported."""
SETTINGS = {"default": "", "fast": "--environment.cone pyramidal --environment.stride 2 --ppo.batches 2"}
"""Options of concent train by the name of the settings."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    out: Path | None = None
    """File of the measurements (.jsonl); what is in it is not measured again."""
    report: tuple[Path, ...] = ()
    """Files of measurements to make the page of."""
    gpus: tuple[int, ...] = (1, 2)
    """Numbers of processes, each with a GPU."""
    settings: tuple[Literal["default", "fast"], ...] = ("default", "fast")
    device: Literal["cuda", "cpu"] = "cuda"
    worlds: int = 4096
    """Worlds on one GPU."""
    strong: bool = False
    """Train with `worlds` in all, too."""
    iterations: int = 80
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


def trained(args: Args, given: list[str], folder: Path, options: str, gpus: int, worlds: int, seed: int) -> Row:
    """Train once and return its curve, its rate and the memory it took."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(gpus)]
    command += ["-m", "concent_warp", "train", *given, "--out", str(folder), "--overwrite", "--device", args.device]
    command += ["--seed", str(seed), "--worlds", str(worlds), "--iterations", str(args.iterations)]
    command += ["--stress.every", "0"]
    command += [part for option in (options, *args.options) for part in option.split()]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with watched_memory(gpus if args.device == "cuda" else 0) as peak:
        subprocess.run(command, env=environment, check=True)
    curve = [(point["steps"], point["seconds"], point["success"]) for point in read_curve(folder)]
    late = curve[len(curve) // 2 :]
    first, last = late[0], late[-1]
    rate = (last[0] - first[0]) / (last[1] - first[1]) if len(late) > 1 else curve[-1][0] / curve[-1][1]
    row = {"gpus": gpus, "worlds": worlds, "seed": seed, "steps_per_second": rate, "curve": curve}
    return {**row, "options": " ".join(filter(None, (options, *args.options))), "memory": max(peak, default=None)}


@contextlib.contextmanager
def watched_memory(gpus: int, every: float = 2.0) -> Iterator[list[int]]:
    """Yield a list of the memory in use on the fullest of the first GPUs visible [MiB], read ever so often [s]."""
    found: list[int] = []
    ended = threading.Event()
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", ",".join(map(str, range(gpus)))).split(",")[:gpus]
    query = ["nvidia-smi", "--query-gpu=memory.used", "--format=csv,noheader,nounits", "-i", ",".join(visible)]

    def watch() -> None:
        while not ended.wait(every):
            with contextlib.suppress(OSError, ValueError, subprocess.SubprocessError):
                found.append(max(map(int, subprocess.check_output(query, text=True).split())))

    thread = threading.Thread(target=watch, daemon=True)
    if gpus:
        thread.start()
    try:
        yield found
    finally:
        ended.set()
        if gpus:
            thread.join()


def measure(args: Args, out: Path) -> None:
    """Train what is wanted."""
    kept = Measurements(out, seconds=args.seconds)
    facts = machine(args.device)
    with tempfile.TemporaryDirectory() as place:
        given = material(Path(place), args.spheres)
        for seed, gpus, name in product(args.seeds, args.gpus, args.settings):
            for worlds in dict.fromkeys((args.worlds, *[args.worlds // gpus] * args.strong)):
                if kept.wanted(key := f"{name}, {gpus} x {worlds}, seed {seed}"):
                    row = trained(args, given, Path(place) / "run", SETTINGS[name], gpus, worlds, seed)
                    kept.add(key, {"machine": facts, "settings": name, **row})
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
    return f"{median(end[0] for end in ends) / 1e6:.1f} M, {median(end[1] for end in ends):.0f} s{some}"


def grouped(rows: Sequence[Row]) -> dict[tuple[str, int, int], list[Row]]:
    """Return the rows by settings, GPUs and worlds of each, in order."""
    groups: dict[tuple[str, int, int], list[Row]] = {}
    for row in sorted(rows, key=lambda row: (list(SETTINGS).index(row["settings"]), row["gpus"], row["worlds"])):
        groups.setdefault((row["settings"], row["gpus"], row["worlds"]), []).append(row)
    return groups


def rate(rows: Sequence[Row]) -> float:
    """Return the environment steps per second of trainings."""
    return median(row["steps_per_second"] for row in rows)


def page(rows: Sequence[Row]) -> str:
    """Return the page."""
    groups = grouped(rows)
    lines = []
    for (name, gpus, worlds), group in groups.items():
        most = max(count for settings, one, count in groups if settings == name and one == 1)
        base = rate(groups[name, 1, most])
        gain = rate(group) / base
        memory = [row["memory"] for row in group if row["memory"] is not None]
        lines.append([
            name, f"{gpus} x {worlds:,}", f"{rate(group):,.0f}", f"{gain:.2f}", f"{gain / gpus:.0%}", f"{len(group)}",
            *(reached(group, mark) for mark in MARKS), f"{median(row['curve'][-1][2] for row in group):.1%}",
            f"{max(memory) / 1024:.1f} GiB" if memory else "-",
        ])  # fmt: skip
    marks = [f"{mark:.0%} after" for mark in MARKS]
    head = [
        "settings",
        "GPUs x worlds",
        "steps/s",
        "of one",
        "of linear",
        "seeds",
        *marks,
        "in the end",
        "memory a GPU",
    ]
    machines = dict.fromkeys(machine_line(row["machine"]) for row in rows)
    return f"""# Training on several GPUs

Insertion stage of the shape sorter with the arm, `concent train` under torchrun with `--stress.every 0`. *fast* is
`{SETTINGS["fast"]}`.
Each GPU has the given number of worlds. Steps are those of all GPUs; rates are those of the second half of the
training, with learning. Seconds leave out start and compilation. Success is that of the episodes of an iteration, while
exploring with noise and perturbations; medians over the seeds. One seed each does not show how learning differs between
numbers of GPUs. Memory is that in use on the fullest GPU, everything counted.

The trainings on one and on two GPUs ran at the same time on one host, on GPUs of their own, those on four alone; other
work was on the host's processors all the time. Two GPUs with default settings and eight GPUs were not tried, and no
training was long enough for 99 %.

![Steps per second by number of GPUs, and success over time](train_gpus.png)

{table(head, lines)}
{" ".join(machines)} Made by `python -m benchmarks.train.gpus --out F`, then `--report F`.
"""


def check(rows: Sequence[Row], paths: Sequence[Path]) -> None:
    """End with a sentence where there is no training on one GPU to compare others with."""
    where = ", ".join(map(str, paths))
    if not rows:
        raise SystemExit(f"{where}: no training at all; measure with --out, then report again")
    missing = {row["settings"] for row in rows} - {row["settings"] for row in rows if row["gpus"] == 1}
    if missing:
        what = f"no training on one GPU with {', '.join(sorted(missing))} settings"
        raise SystemExit(f"{where}: {what}; measure it with --gpus 1, then report again")


def plot(rows: Sequence[Row]) -> None:
    """Draw rates by number of GPUs, and success over time."""
    groups = grouped(rows)
    figure, (scaling, learning) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for name, colour in zip(SETTINGS, ("tab:blue", "tab:orange"), strict=True):
        most = max((worlds for settings, _, worlds in groups if settings == name), default=0)
        chosen = {key: of for key, of in groups.items() if key[0] == name and key[2] == most}
        points = {gpus: rate(of) / 1e3 for (_, gpus, _), of in chosen.items()}
        if not points:
            continue
        scaling.plot(list(points), list(points.values()), "o-", color=colour, label=name)
        scaling.plot([1, max(points)], [points[1], points[1] * max(points)], ":", color=colour, label=f"{name}, linear")
        for number, gpus in enumerate(points):
            _, seconds, success = zip(*groups[name, gpus, most][0]["curve"], strict=True)
            shade = 0.4 + 0.6 * (number + 1) / len(points)
            learning.plot(seconds, [100 * one for one in success], color=colour, alpha=shade, lw=1 + number,
                          label=f"{name}, {gpus} GPU{'s' * (gpus > 1)}")  # fmt: skip
    scaling.set(xlabel="GPUs", ylabel="1,000 environment steps/s, with learning", ylim=(0, None))
    scaling.set_xticks(sorted({gpus for _, gpus, _ in groups}))
    learning.set(xlabel="seconds of training", ylabel="success while exploring [%]", ylim=(0, 100))
    for axes in (scaling, learning):
        axes.legend(fontsize=8)
        axes.grid(alpha=0.3)
    figure.savefig(FOLDER / f"{NAME}.png", dpi=110)


def main() -> None:
    """Measure or report."""
    args = tyro.cli(Args, description=__doc__)
    if args.out is not None:
        measure(args, args.out)
    if args.report:
        rows = {key: row for path in args.report for key, row in Measurements(path).rows.items()}
        check(list(rows.values()), args.report)
        write_data(NAME, {"rows": list(rows.values())})
    if args.out is None:
        rows = read_data(NAME)["rows"]
        plot(rows)
        write_page(NAME, page(rows))


if __name__ == "__main__":
    main()
