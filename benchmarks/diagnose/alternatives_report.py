"""Page and figure of `alternatives.py`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.pages import FOLDER, machine_line, table, write_page

NAME = "diagnose_alternatives"
WAYS = ("diagnosis", "everything at once", "sysid toolbox")
COLOURS = ("#1f5fa8", "#c8571b", "#3a8f5c")
RESAMPLES = 10_000
TICKS = (0.5, 0.7, 1, 1.5, 2, 3, 5, 7, 10, 15, 20, 30, 50, 100)


def write_report(data: dict[str, Any]) -> None:
    """Write the page and the figure."""
    draw(data["rows"])
    write_page(NAME, page(data))


def page(data: dict[str, Any]) -> str:
    """Return the page."""
    rows: dict[str, Any] = data["rows"]
    known = {name: row for name, row in rows.items() if row["hidden"] is not None}
    real = {name: row for name, row in rows.items() if row["hidden"] is None}
    text = f"""# Diagnosis against plain fits

Written by `benchmarks/diagnose/alternatives.py`; do not edit. {machine_line(data["machine"])}

`python -m benchmarks.diagnose.alternatives`: three methods correct a model that lacks an effect, on the same
recordings, and are scored on the same other recordings:

- *diagnosis*: `concent diagnose` with default settings; the model with all accepted effects;
- *everything at once*: the parameters of all candidate effects of the library and the initial states, fitted together
  by bounded robust least squares without a selection;
- *sysid toolbox*: `mujoco.sysid`, fitting friction, damping and armature of joints, gains of drives, masses, inertias,
  friction and compliance of contacts. Initial states, lag, backlash, tilt and sensors are not fitted: a user of the
  toolbox would have to write these models.

An effect is *blamed* where the 95 % interval of one of its parameters excludes its null value; for the diagnosis, where
it is accepted (a group counts as right if the hidden effect is in it).

## Data with a known truth

{len(known)} data sets of Reality, each with a second recording for scoring. So few do not show
which method is better on a single effect.
"""
    head = ["", *WAYS]
    text += "\n" + table(head, summary(known)) if known else ""
    text += """
*Error over floor*: geometric mean over the data sets of the error on the other recording, divided by that of the model
with the library's effects at their true values. *Wrong cause blamed*: share of all data sets in which an effect is
blamed that is not hidden. *Hidden effect blamed*: share of the data sets with a hidden effect in which it is blamed.
Intervals are 95 %: bootstrapped over the data sets, Wilson's for shares.

![Errors of each way over the floor](diagnose_alternatives.png)

Errors on the other recording, residual over noise:

"""
    text += table(["data set", "nominal model", "truth", *WAYS], [errors(name, row) for name, row in known.items()])
    text += "\nBlamed effects (hidden ones in bold; *or*: named as a group that the data do not distinguish):\n\n"
    text += table(["data set", *WAYS], [blame(name, row) for name, row in known.items()])
    if real:
        text += """
## Measured data

As in [the diagnoses of measured data](diagnose_real.md): error in degrees over windows of the servo at the other gain,
in millimetres over windows of other tosses.

"""
        text += table(["data", "unit", "as published", *WAYS], [measured(name, row) for name, row in real.items()])
        text += "\nBlamed effects:\n\n" + table(["data", *WAYS], [blame(name, row) for name, row in real.items()])
    return text


def summary(rows: dict[str, Any]) -> list[list[str]]:
    """Return the rows of the first table."""
    every = list(rows.values())
    some = [row for row in every if row["hidden"]]
    heads = ("error over floor", "wrong cause blamed", "wrong causes a data set", "hidden effect blamed", "time")
    lines = [[head] for head in heads]
    for way in WAYS:
        over = np.log([row["ways"][way]["error"] / row["floor"] for row in every if row["floor"]])
        low, high = np.exp(bootstrap(over))
        lines[0].append(f"{np.exp(over.mean()):.2f} ({low:.2f} to {high:.2f})")
        lines[1].append(share([bool(row["ways"][way]["wrong"]) for row in every]))
        lines[2].append(f"{np.mean([len(row['ways'][way]['wrong']) for row in every]):.1f}")
        lines[3].append(share([bool(row["ways"][way]["right"]) for row in some]))
        lines[4].append(f"{np.mean([row['ways'][way]['seconds'] for row in every]):.0f} s")
    return lines


def bootstrap(values: np.ndarray) -> tuple[float, float]:
    """Return the 95 % interval of a mean."""
    rows = np.random.default_rng(0).integers(len(values), size=(RESAMPLES, len(values)))
    low, high = np.percentile(values[rows].mean(axis=1), [2.5, 97.5])
    return float(low), float(high)


def share(hits: Sequence[bool]) -> str:
    """Return a share with Wilson's 95 % interval."""
    n, k, z = len(hits), sum(hits), 1.96
    if not n:
        return "-"
    centre = (k + z**2 / 2) / (n + z**2)
    reach = z / (n + z**2) * np.sqrt(k * (n - k) / n + z**2 / 4)
    return f"{k} of {n} ({100 * max(centre - reach, 0):.0f} to {100 * min(centre + reach, 1):.0f} %)"


def errors(name: str, row: dict[str, Any]) -> list[str]:
    """Return the errors on one data set."""
    floor = "-" if row["floor"] is None else f"{row['floor']:.2f}"
    return [name, f"{row['nominal']:.2f}", floor, *(f"{row['ways'][way]['error']:.2f}" for way in WAYS)]


def measured(name: str, row: dict[str, Any]) -> list[str]:
    """Return the errors on measured data."""
    return [name, row["unit"], f"{row['nominal']:.2f}", *(f"{row['ways'][way]['error']:.2f}" for way in WAYS)]


def blame(name: str, row: dict[str, Any]) -> list[str]:
    """Return the blamed effects of one data set."""
    hidden = row["hidden"] or []
    cells = []
    for way in WAYS:
        found = row["ways"][way]
        cells.append(", ".join(cause(n, hidden, found) for n in found["blamed"]) or "nothing")
    return [name, *cells]


def cause(name: str, hidden: Sequence[str], found: dict[str, Any]) -> str:
    """Return a blamed effect: in bold if it is hidden, with the hidden effect if that is in its group."""
    if name in hidden:
        return f"**{name}**"
    group = found.get("right", []) if name not in found.get("wrong", [name]) else []
    return f"{name} or **{', '.join(group)}**" if group else name


def draw(rows: dict[str, Any]) -> None:
    """Draw the errors over the floor, one row a data set."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    chosen = [(name, row) for name, row in rows.items() if row["floor"]]
    if not chosen:
        return
    figure, axis = plt.subplots(figsize=(9, 0.42 * len(chosen) + 1.6))
    places = np.arange(len(chosen))[::-1]
    axis.scatter([row["nominal"] / row["floor"] for _, row in chosen], places, marker="|", s=140, color="black",
                 label="nominal model, nothing fitted")  # fmt: skip
    for k, way in enumerate(WAYS):
        over = [row["ways"][way]["error"] / row["floor"] for _, row in chosen]
        axis.scatter(over, places + 0.18 * (1 - k), s=36, color=COLOURS[k], label=way)
    axis.axvline(1.0, color="grey", linewidth=1)
    axis.set_yticks(places, [name for name, _ in chosen])
    axis.set_xscale("log")
    axis.xaxis.set_major_locator(FixedLocator(TICKS))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.set_xlabel("error on the other recording, over that of the true model")
    axis.grid(axis="x", alpha=0.3)
    axis.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, frameon=False)
    figure.tight_layout()
    figure.savefig(FOLDER / f"{NAME}.png", dpi=110)
    plt.close(figure)
