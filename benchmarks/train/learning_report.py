"""The page of how policies learn, from the trainings of `learning.py`.

python -m benchmarks.train.learning_report runs/table1 [all]    # takes the curves in and writes the page
python -m benchmarks.train.learning_report                      # the page anew
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pages import FOLDER, machine_line, read_data, table, write_data, write_page
from benchmarks.train.cases import CASES
from benchmarks.train.learning import RESULT, changed
from concent_warp.train.learning.metrics import read_curve

NAME = "train_learning"
KEPT = ("steps", "seconds", "success", "chain success", "return")
POINTS = 150
"""Points of a curve that are kept."""
BARS = (0.5, 0.9, 0.95, 0.99)
"""Success rates whose first time is reported."""
ABOUT = """\
`python -m benchmarks.train.learning --out D`: trainings of the shape sorter with the arm. Each seed has its own
demonstration, model and policy. *while exploring* is the share of the episodes ended in an iteration that end with
object 1 in place, with actions sampled from the policy; *without exploration* is a test after the training with the
mean actions, from unseen reset states in the same simulation, with Wilson's 95 % interval. Seconds are those of
rollouts and updates; reading the model, sampling reset states, compilation and capture are *start*.

Settings are named by their difference from the present defaults; earlier trainings had other defaults, and no settings
that came later. In chains, stages paid 5 in every later step until 2026-11-27. With `reward.completion 250` the end of
the task was bootstrapped, as that of time is: the value of a block at rest went on. Insertion had no finish until then.
Chains with the default settings and insertions of seeds 34 to 49 had other work on the host's processors beside them.

What the figures do not show: success in Reality ([Table 1](train_table1.md)), which varies strongly between seeds
with equal success here. A training stops when its time is over, so that seconds on different hosts are not comparable.
"""


def taken(folder: Path, stage: str) -> dict[str, Any]:
    """Return the trainings in a folder."""
    found = {}
    for path in sorted((folder / "runs").glob(f"*_{stage}_*/{RESULT}")):
        ordered = read_curve(path.parent)
        step = max(1, len(ordered) // POINTS)
        thinned = [*ordered[:-1:step], ordered[-1]]
        result = json.loads(path.read_text())
        result["first"] = {str(bar): first(ordered, bar) for bar in BARS}
        result["curve"] = {name: [row[name] for row in thinned] for name in KEPT if name in ordered[0]}
        result["rate"] = ordered[-1]["steps"] / ordered[-1]["seconds"]
        found[f"{path.parent.name} {changed(result['settings'])}".strip()] = result
    return found


def first(rows: list[dict[str, float]], bar: float) -> list[float] | None:
    """Return steps and seconds from which three iterations in a row reach this success rate while exploring."""
    name = "chain success" if "chain success" in rows[0] else "success"
    fine = [row[name] >= bar for row in rows]
    for k in range(len(rows) - 2):
        if all(fine[k : k + 3]):
            return [rows[k]["steps"], rows[k]["seconds"]]
    return None


def page(data: dict[str, Any]) -> str:
    """Return the page."""
    parts = ["# How policies learn", "Written by `benchmarks/train/learning_report.py`; do not edit.", ABOUT]
    for stage, title in (("insert", "Insertion"), ("all", "All stages chained, objects anywhere")):
        staged = {name: run for name, run in data.items() if f"_{stage}_" in name}
        for k, how in enumerate(sorted({changed(run["settings"]) for run in staged.values()})):
            runs = {name: run for name, run in staged.items() if changed(run["settings"]) == how}
            picture = f"{NAME}_{stage}{k or ''}.png"
            draw(runs, FOLDER / picture)
            parts += [f"## {title}", f"With `{how}`." if how else "With the default settings."]
            parts += [machine_line(next(iter(runs.values()))["machine"]), summary(runs)]
            parts += [f"![Curves]({picture})", "Each training:", each(runs)]
    return "\n\n".join(parts)


def summary(runs: dict[str, Any]) -> str:
    """Return a table of the cases."""
    lines = []
    for name, case in CASES.items():
        of = [run for run in runs.values() if run["case"] == name]
        if not of:
            continue
        times = [run["first"]["0.99"] for run in of]
        reached = [time[1] for time in times if time is not None]
        rates = [run["simulation"]["rate"] for run in of]
        span = f"{min(reached):.0f} to {max(reached):.0f} s" if reached else ""
        lines.append([
            case.title, str(len(of)), f"{len(reached)} of {len(of)}", span, f"{np.mean(rates):.2%}",
            f"{min(rates):.2%}", f"{np.mean([run['seconds'] for run in of]):.0f}",
            f"{np.mean([run['rate'] for run in of]):,.0f}",
        ])  # fmt: skip
    head = ["case", "seeds", "99 % while exploring", "after", "without exploration", "worst", "seconds", "steps/s"]
    return table(head, lines)


def each(runs: dict[str, Any]) -> str:
    """Return a table of the trainings."""
    lines = []
    for run in sorted(runs.values(), key=lambda run: (list(CASES).index(run["case"]), run["seed"])):
        low, high = run["simulation"]["interval"]
        marks = [run["first"][str(bar)] for bar in BARS]
        lines.append([
            f"{CASES[run['case']].title}, {run['seed']}", f"{run['worlds']:,}", f"{run['start_seconds']:.0f}",
            *("" if mark is None else f"{mark[0] / 1e6:.1f} M, {mark[1]:.0f} s" for mark in marks),
            f"{run['simulation']['rate']:.2%} ({low:.1%} to {high:.1%})",
        ])  # fmt: skip
    return table(
        ["case, seed", "worlds", "start, s", *(f"{bar:.0%} after" for bar in BARS), "without exploration"], lines
    )


def draw(runs: dict[str, Any], path: Path) -> None:
    """Draw success by steps and by time: each training thin, the mean of a case's seeds thick."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 4), sharey=True, layout="constrained")
    cases = [name for name in CASES if any(run["case"] == name for run in runs.values())]
    for k, name in enumerate(cases):
        of = [run["curve"] for run in runs.values() if run["case"] == name]
        success = "chain success" if "chain success" in of[0] else "success"
        for axis, what, scale in zip(axes, ("steps", "seconds"), (1e6, 1.0), strict=True):
            for curve in of:
                axis.plot(np.array(curve[what]) / scale, curve[success], c=f"C{k}", lw=0.6, alpha=0.5)
            common = np.linspace(0, min(curve[what][-1] for curve in of), 200)
            mean = np.mean([np.interp(common, curve[what], curve[success]) for curve in of], axis=0)
            axis.plot(common / scale, mean, c=f"C{k}", lw=2, label=CASES[name].title)
    axes[0].set(xlabel="environment steps [10^6]", ylabel="success while exploring", ylim=(0, 1.02))
    axes[1].set(xlabel="time of learning [s]")
    for axis in axes:
        axis.axhline(0.99, c="0.7", lw=0.8, zorder=0)
    axes[1].legend(fontsize=8)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main() -> None:
    """Take trainings in and write the page."""
    data = read_data(NAME)
    if len(sys.argv) > 1:
        data |= taken(Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else "*")
    write_data(NAME, data)
    write_page(NAME, page(data))


if __name__ == "__main__":
    main()
