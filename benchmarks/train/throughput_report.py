"""The pages of the throughput of training and of the virtual collision penalty, from what was measured.

python -m benchmarks.train.throughput_report F...   # files of benchmarks/train/throughput.py, taken into docs
python -m benchmarks.train.throughput_report F --section "other settings" --remark "..."    # under a heading of its own
python -m benchmarks.train.throughput_report        # the pages anew
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import tyro

from benchmarks.measurements import Measurements, Row
from benchmarks.pages import FOLDER, machine_line, read_data, table, write_data, write_page

NAME = "train_throughput"
PICTURE = "train_throughput_vcp.png"
ABOUT = """\
`python -m benchmarks.train.throughput --out F`: environment steps per second of the insertion stage of the shape sorter
with the arm. A step is one action, `decimation` steps of the simulator; actions are random; episodes end and restart.

*environment* is all of `Environment.step` without learning: commands, physics, contact pairs, virtual collisions,
reward, resets, observation. *bare* is `mujoco_warp.step`, as often as an action has steps, captured in one graph with
the same model and buffers, from the same states with the same commands, which are restored before each launch outside
of the timing. *at rest*: the engine with constant commands, which comes to rest and is faster. Medians without
compilation and capture.

The profile has the times of events on the device: *distances* are contact pairs and virtual collisions, *judge* is
reward, ends of episodes and resets, *poses and pairs* their consequences.

What the figures do not show: other tasks (time grows with spheres and contacts), and, in the first two sections, the
default settings: surface points in the penalty, on by default, are off there. Sections are of different machines with
different loads.
"""
VCP = """\
`python -m benchmarks.train.throughput --out F --collisions vcp full`: the same environment with the spheres
of the contact events in the physics and the others in the penalty (VCP), and with all spheres in the physics (FULL).
Actions are random.

A batched engine has buffers for a fixed number of contacts. *fixed* is FULL with VCP's buffers: contacts beyond them
are dropped, and the states are wrong though finite. *fitting* is FULL with buffers doubled until no world drops a
contact in a separate run; in the timed run a few may. *dropped* is the share of world steps with dropped contacts;
*diverged* the worlds with infinite or implausible states, of the episodes that ended. Memory is that of the environment
with its graphs, beyond one of 16 worlds.

What the figures do not show: default settings. The first section is without surface points in the penalty, which are on
by default; the second has them, with pyramidal cones and steps twice as long.
"""


@dataclass(frozen=True)
class Args:
    """Command line."""

    files: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Measurements to add; all are of one machine."""
    section: str = ""
    """Their heading besides the device; by default they are added to those of that kind of device."""
    remark: str = ""
    """Remark on the measurements."""


def memory(r: Row) -> str:
    """Return the memory of a measurement in words; a dash where it was not measured apart from others."""
    return f"{r['memory_gib']:.2f}" if "memory_gib" in r else "-"


def at(row: Row, name: str) -> float:
    """Return environment steps per second of a median time."""
    return 1e3 * row["worlds"] / median(row[name])


def share(row: Row) -> float:
    """Return the share of the bare engine's rate."""
    return at(row, "environment_ms") / at(row, "bare_ms")


def of(rows: list[Row], kind: str) -> list[Row]:
    """Return the rows of a kind that came to a result, in the order of their number of worlds."""
    return sorted((r for r in rows if r["key"].startswith(kind) and "error" not in r), key=lambda r: r["worlds"])


def throughput(rows: list[Row]) -> list[str]:
    """Return the tables of rates."""
    lines, profiles = [], []
    for r in of(rows, "rate vcp"):
        name = f"{r['worlds']:,}"
        rates = [at(r, "bare_held_ms"), at(r, "bare_ms"), at(r, "environment_ms")]
        lines.append([
            name, *(f"{rate:,.0f}" for rate in rates), f"{share(r):.1%}", f"{r['contacts']:.0f}", f"{r['rows']:.0f}",
            f"{r['solver_iterations']['mean']:.1f}", f"{r['solver_iterations']['most']:.0f}", f"{r['overflow']:.2%}",
            memory(r),
        ])  # fmt: skip
        total = median(r["environment_ms"])
        profiles.append([name, f"{total:.2f}", *(f"{value:.2f}" for value in r["profile_ms"].values())])
    if not lines:
        return []
    head = ["worlds", "bare, at rest", "bare", "environment", "share", "contacts", "rows", "iterations", "most"]
    names = list(of(rows, "rate vcp")[0]["profile_ms"])
    return [
        table([*head, "steps that dropped contacts", "GiB"], lines),
        "Contacts, constraint rows and solver iterations are means over worlds; *most* is the largest number of them.",
        "Where a step's time goes [ms]:",
        table(["worlds", "step", *names], profiles),
    ]


def learning(rows: list[Row]) -> list[str]:
    """Return the table of PPO."""
    lines = []
    for r in [*of(rows, "ppo"), *(r for r in of(rows, "alternatives") if "PPO" in r["key"])]:
        title = r["key"].split(": ")[1] if ": " in r["key"] else ""
        collecting, updating = median(r["collecting_ms"]), median(r["updating_ms"])
        rate = 1e3 * r["worlds"] * r["steps"] / (collecting + updating)
        name = f"{r['worlds']:,}, {r['spheres']} spheres" + (f", {title}" if title else "")
        lines.append([name, f"{rate:,.0f}", f"{collecting:.0f}", f"{updating:.0f}"])
    text = "With PPO; an iteration is 24 steps of each environment and an update of 5 epochs x 4 batches unless stated:"
    return [text, table(["worlds", "steps/s", "collecting, ms", "updating, ms"], lines)] if lines else []


def alternatives(rows: list[Row]) -> list[str]:
    """Return the table of other settings."""
    lines = []
    for r in of(rows, "alternatives"):
        if "environment_ms" in r:
            title = r["key"].split(": ")[1]
            rates = [f"{at(r, 'bare_ms'):,.0f}", f"{at(r, 'environment_ms'):,.0f}", f"{share(r):.1%}"]
            faults = [f"{r['overflow']:.2%}", f"{r['diverged']:.0f} of {r['episodes']:.0f}"]
            lines.append([f"{title} ({r['worlds']:,})", *rates, *faults])
    head = ["settings (worlds)", "bare", "environment", "share", "steps that dropped contacts", "diverged"]
    return ["With other settings:", table(head, lines)] if lines else []


def kernels(rows: list[Row]) -> list[str]:
    """Return the tables of kernels."""
    parts = []
    for r in of(rows, "kernels"):
        lines = [[f"`{name}`", f"{launches:.0f}", f"{ms:.3f}"] for name, launches, ms in r["kernels"][:21]]
        parts += [
            f"Slowest kernels of a step, {r['worlds']:,} worlds ({r['collision']}). Of the solver's loop "
            "within the graph the profiler records the first pass only:",
            table(["kernel", "launches", "ms"], lines),
        ]
    return parts


def penalty(rows: list[Row]) -> list[str]:
    """Return the tables of VCP against FULL."""
    lines = []
    vcp = {r["worlds"]: r for r in of(rows, "rate vcp")}
    for r in of(rows, "rate full"):
        small = vcp.get(r["worlds"])
        if small is not None:
            times = f"{at(small, 'environment_ms') / at(r, 'environment_ms'):.1f}"
            lines.append([*cells(small, "VCP"), ""] if r["key"].endswith("fixed") else [])
            lines.append([*cells(r, "FULL, " + r["key"].split()[-1]), times])
    head = ["worlds", "spheres", "steps/s", "buffers", "contacts", "dropped", "diverged", "GiB", "VCP is quicker by"]
    return [table(head, [line for line in lines if line])] if lines else []


def cells(r: Row, name: str) -> list[str]:
    """Return what the table of VCP against FULL says of a row."""
    return [
        f"{r['worlds']:,}", f"{r['spheres']} ({name})", f"{at(r, 'environment_ms'):,.0f}",
        f"{r['nconmax']} / {r['njmax']}", f"{r['contacts']:.0f}", f"{r['overflow']:.2%}",
        f"{r['diverged']:.0f} of {r['episodes']:.0f}", memory(r),
    ]  # fmt: skip


def picture(rows: list[Row]) -> bool:
    """Draw VCP against FULL by the number of worlds; return whether there is something to draw."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    full = {name: [r for r in of(rows, "rate full") if r["key"].endswith(name)] for name in ("fixed", "fitting")}
    if not full["fitting"]:
        return False
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    counts = {r["worlds"] for r in full["fitting"]}
    curves = {"VCP": [r for r in of(rows, "rate vcp") if r["worlds"] in counts]}
    curves |= {f"FULL, {name}": found for name, found in full.items()}
    for name, found in curves.items():
        line = axes.plot([r["worlds"] for r in found], [at(r, "environment_ms") for r in found], "o-", label=name)[0]
        bad = [r for r in found if r["overflow"] > 0]
        axes.plot([r["worlds"] for r in bad], [at(r, "environment_ms") for r in bad], "x", ms=14, c=line.get_color())
    axes.set(xscale="log", yscale="log", xlabel="worlds", ylabel="environment steps/s")
    axes.set_xticks(sorted(counts), [f"{n:,}" for n in sorted(counts)])
    axes.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
    axes.set_title("x: contacts were dropped")
    axes.legend()
    figure.savefig(FOLDER / PICTURE, dpi=150)
    plt.close(figure)
    return True


def section(result: dict[str, Any], tables: list[str]) -> list[str]:
    """Return the part of a page of one machine, nothing where nothing was measured."""
    facts, remark = result["machine"], [result["remark"]] if "remark" in result else []
    title = result.get("title", facts.get("device", facts["processor"]))
    return [f"## {title}", machine_line(facts), *remark, *tables] if tables else []


def taken(args: Args) -> dict[str, Any]:
    """Return the stored data with the measurements of files taken in."""
    data = read_data(NAME)
    if missing := [path for path in args.files if not path.is_file()]:
        raise SystemExit(f"{missing[0]}: no such file of measurements; benchmarks/train/throughput.py --out writes one")
    for path in args.files:
        for key, row in Measurements(path).rows.items():
            facts = row["machine"]
            cuda = "device" in facts and facts["device"] != "cpu"
            part = data.setdefault(f"{'cuda' if cuda else 'cpu'} {args.section}".strip(), {"rows": {}})
            part["machine"] = facts
            if args.section:
                part["title"] = f"{facts['device' if cuda else 'processor']}, {args.section}"
            if args.remark:
                part["remark"] = args.remark
            part["rows"][key] = {name: value for name, value in row.items() if name != "machine"}
    return data


def main() -> None:
    """Take measurements in and write the pages."""
    data = taken(tyro.cli(Args, description=__doc__))
    write_data(NAME, data)
    written = "Written by `benchmarks/train/throughput_report.py`; do not edit."
    pages = {NAME: ["# Throughput of training", written, ABOUT], "train_vcp": ["# VCP against FULL", written, VCP]}
    for result in data.values():
        rows = list(result["rows"].values())
        tables = [*throughput(rows), *learning(rows), *alternatives(rows), *kernels(rows)]
        pages[NAME] += section(result, tables)
        drawn = [f"![Rates]({PICTURE})"] if result is data.get("cuda") and picture(rows) else []
        pages["train_vcp"] += section(result, [*penalty(rows), *drawn])
    for name, parts in pages.items():
        write_page(name, "\n\n".join(parts))


if __name__ == "__main__":
    main()
