"""The page and the figure of `cube_tosses.py`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

RATE = 148.0
"""Nominal rate of the measurements [Hz]; the period in the code published with them makes it 147."""
PERIOD = 0.0068
GRAVITY = 9.81
MEASURES = {
    "window": ("Surface points over windows of 0.1 s", 1e3, "mm"),
    "position": ("Centre over the whole toss, open loop", 1e3, "mm"),
    "rotation": ("Orientation over the whole toss, open loop", np.degrees(1), "deg"),
}


def write_report(document: dict[str, Any], out: Path) -> None:
    """Write ``fit_cube_tosses.md`` and ``data/fit_cube_tosses.png``."""
    draw(document, out / "data" / "fit_cube_tosses.png")
    (out / "fit_cube_tosses.md").write_text(page(document))


def length_scale(document: dict[str, Any]) -> float:
    """Return the length of the file's metre [m] that its free fall implies at the nominal rate."""
    return document["free_fall"] * (PERIOD * RATE) ** 2 / GRAVITY


def page(document: dict[str, Any]) -> str:
    """Return the page in Markdown."""
    kinds = [k for k in (False, True) if any(r["friction"] == k for r in document["results"])]
    parts = [introduction(document)]
    parts += [section(document, [r for r in document["results"] if r["friction"] == kind]) for kind in kinds]
    parts.append(interpretation(document))
    return "\n".join(line for part in parts for line in part) + "\n"


def introduction(document: dict[str, Any]) -> list[str]:
    """Return what is measured, how, and on what."""
    from benchmarks.fit.cube_tosses_data import SPHERES

    results, machine = document["results"], document["machine"]
    simulations = np.mean([r["simulations"] for r in results])
    lines = [
        "# Fitting a sphere cube to measured tosses",
        "",
        "Written by `benchmarks/fit/cube_tosses.py`; do not edit.",
        "",
        f"{document['tosses']} measured tosses of a cube on a board (ContactNets). Each fit uses"
        f" {len(results[0]['fitted_names'])} of them, sampled at random, and starts from {SPHERES} inset spheres of 4"
        " mm radius that form a cube with an edge 5 % too small or too large; the other tosses are used for scoring."
        " The box, its markers and its normals are scaled alike, so that the true size is not in the fitted model."
        " Contact parameters and gravity are not fitted.",
        "",
        f"Measured {document['date']} by `{document['command']}` on {machine['cpu']}, {machine['cores']} cores, python"
        f" {machine['python']}: {document['seconds']:.0f} s in all, for {len(results)} fits of {simulations:.0f}"
        f" simulations of {document['fit']['window']:g} s each; a fit takes"
        f" {np.mean([r['seconds']['cpu'] for r in results]):.0f} s of one processor.",
        "",
        "Errors are means over tosses; *fall* has its 95 % bootstrap interval over tosses, and p-values are of"
        " two-sided paired tests. *True size* is the error of a cube of the published size with unfitted spheres. The"
        " *edge* is the distance between opposite faces, each the mean over its four quadrants of the farthest reach"
        " of a sphere, mean of three axes; *stands at* is twice the height at which the fitted cube rests, mean of"
        " its six faces. Sphere friction: median, 10th and 90th percentile.",
        "",
    ]
    if document["quick"]:
        lines += ["**A quick run: few tosses and generations; the figures mean little.**", ""]
    return lines


def section(document: dict[str, Any], results: list[dict[str, Any]]) -> list[str]:
    """Return the tables of the fits of one kind."""
    friction = results[0]["friction"]
    lines = [f"## {'Positions and friction' if friction else 'Positions'} of the spheres fitted"]
    for name, (title, unit, symbol) in MEASURES.items():
        lines += ["", f"{title} [{symbol}]:", "", *table(results, name, unit)]
    if not friction:
        lines += ["", "![Error of each toss before and after, and the recovered edges](data/fit_cube_tosses.png)"]
    lines += [
        "",
        "Recovered edge [mm]:",
        "",
        "| split | start | x | y | z | edge | off the published edge | stands at | sphere friction |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    true = 1e3 * document["edge"]
    for r in results:
        widths = " | ".join(f"{1e3 * w:.1f}" for w in r["widths"])
        low, middle, high = r["sphere_friction"]
        lines.append(
            f"| {r['seed']} | {1e3 * r['start_edge']:.1f} | {widths} | {1e3 * r['edge']:.1f} |"
            f" {100 * (1e3 * r['edge'] / true - 1):+.1f} % | {1e3 * r['rests_at']:.1f} |"
            + (f" {middle:.2f} ({low:.2f} to {high:.2f}) |" if friction else f" {middle:.2f} |")
        )
    starts = "; ".join(
        f"from {1e3 * f * document['edge']:.1f} mm {mean:.1f} mm" for f, mean in by_start(results).items()
    )
    lines += ["", f"All: **{spread(results)}** (mean and standard deviation) against {true:.1f} mm; {starts}.", ""]
    return lines


def interpretation(document: dict[str, Any]) -> list[str]:
    """Return what the figures do not show."""
    true, scale, resting = 1e3 * document["edge"], length_scale(document), 1e3 * document["resting_edge"]
    lines = [
        "## What the figures do not show",
        "",
        *[whole_toss(results) for kind in (False, True) if (results := of_kind(document, kind))],
        f"- With the published friction of {document['friction']} the cube slides too far whatever its size. A contact"
        " takes the larger friction of board and sphere, so a fit can raise friction and not lower it.",
        "- Windows begin at measured states and end before differences at the start have grown; the fit minimises"
        " them.",
        "- The unit of length of the data is uncertain by about 2 %: the resting cube implies an edge of"
        f" {resting:.1f} mm (centre {resting / 2:.2f} mm above the board), free fall of {document['free_fall']:.3f} +-"
        f" {document['free_fall_error']:.3f} m/s^2 at a period of {1e3 * PERIOD:.1f} ms ({scale * GRAVITY:.2f} at the"
        f" nominal {RATE:.0f} Hz) a metre of {1 / scale:.3f} m, in which {true:.1f} mm are {true * scale:.1f} mm.",
    ]
    for friction, words in ((False, "positions alone"), (True, "positions and friction")):
        if results := [r for r in document["results"] if r["friction"] == friction]:
            edge = 1e3 * float(np.mean([r["edge"] for r in results]))
            lines.append(
                f"- Fitted by {words}, an edge of {edge:.1f} mm in the unit of the data is {edge / scale:.1f} mm"
                f" ({100 * (edge / scale / true - 1):+.1f} %)."
            )
    lines.append(
        "- Effects that the model lacks, such as restitution and rounded corners, act on the fitted size as well."
    )
    return lines


def of_kind(document: dict[str, Any], friction: bool) -> list[dict[str, Any]]:
    """Return the fits with or without friction among the fitted parameters."""
    return [r for r in document["results"] if r["friction"] == friction]


def whole_toss(results: list[dict[str, Any]]) -> str:
    """Return how the errors of whole tosses change, as an item of a list."""
    falls = {name: [100 * r[name]["fall"] for r in results] for name in ("position", "rotation")}
    words = "positions and friction" if results[0]["friction"] else "positions alone"
    low, high = min(falls["position"]), max(falls["position"])
    worse = sum(fall < 0 for fall in falls["rotation"])
    return (
        f"- Over whole tosses, with {words} fitted, the error of position falls by {low:.0f} to {high:.0f} %, and the"
        f" error of orientation grows in {worse} of {len(results)} fits."
    )


def spread(results: list[dict[str, Any]]) -> str:
    """Return mean and standard deviation of the recovered edges, in words."""
    edges = 1e3 * np.array([r["edge"] for r in results])
    return f"{edges.mean():.1f} +- {edges.std(ddof=1) if len(edges) > 1 else 0:.1f} mm"


def by_start(results: list[dict[str, Any]]) -> dict[float, float]:
    """Return the mean recovered edge by the factor of the start [mm]."""
    factors = sorted({r["factor"] for r in results})
    return {f: 1e3 * float(np.mean([r["edge"] for r in results if r["factor"] == f])) for f in factors}


def table(results: list[dict[str, Any]], name: str, unit: float) -> list[str]:
    """Return the rows of one measure of error."""
    lines = [
        "| split | start, mm | tosses | before | after | fall | better tosses | Wilcoxon p | t-test p | true size |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for r in results:
        e = r[name]
        lines.append(
            f"| {r['seed']} | {1e3 * r['start_edge']:.1f} | {e['tosses']} | {unit * e['before']:.2f} |"
            f" {unit * e['after']:.2f} | {100 * e['fall']:.0f} % ({100 * e['fall_low']:.0f} to"
            f" {100 * e['fall_high']:.0f}) | {100 * e['improved']:.0f} % | {e['wilcoxon_p']:.1e} | {e['t_p']:.1e} |"
            f" {unit * e['true_size']:.2f} |"
        )
    return lines


def draw(document: dict[str, Any], path: Path) -> None:
    """Draw the error of each toss before and after, and the recovered edges."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    kind = document["results"][0]["friction"]
    results = [r for r in document["results"] if r["friction"] == kind]
    first = [r for r in results if r["seed"] == results[0]["seed"]]
    colours = {0.95: "tab:blue", 1.05: "tab:orange"}
    figure, axes = plt.subplots(1, len(first) + 1, figsize=(4.2 * (len(first) + 1), 4.2), layout="constrained")
    errors = [1e3 * np.array(r["tosses"][key]) for r in first for key in ("before", "after")]
    top = 1.08 * max(float(np.nanmax(e)) for e in errors)
    for axis, r in zip(axes, first, strict=False):
        before, after = (1e3 * np.array(r["tosses"][key]) for key in ("before", "after"))
        axis.plot([0, top], [0, top], color="0.6", lw=1)
        axis.scatter(before, after, s=10, alpha=0.6, color=colours[r["factor"]], linewidths=0)
        axis.set(xlim=(0, top), ylim=(0, top), aspect="equal")
        axis.set_xlabel("error before the fit [mm]")
        axis.set_ylabel("error after the fit [mm]")
        axis.set_title(
            f"start {1e3 * r['start_edge']:.1f} mm: {100 * np.mean(after < before):.0f} % of"
            f" {np.isfinite(before).sum()} unseen tosses better",
            fontsize=9,
        )
    axis = axes[-1]
    for r in results:
        x = r["seed"] + (-0.08 if r["factor"] < 1 else 0.08)
        axis.annotate(
            "",
            (x, 1e3 * r["edge"]),
            (x, 1e3 * r["start_edge"]),
            arrowprops={"arrowstyle": "->", "color": colours[r["factor"]]},
        )
        axis.scatter(x, 1e3 * r["edge"], s=24, color=colours[r["factor"]], zorder=3)
    seeds = sorted({r["seed"] for r in results})
    lines = {
        "published": (1e3 * document["edge"], "-"),
        "published, in the file's unit": (1e3 * document["edge"] * length_scale(document), "--"),
        "twice the height at rest": (1e3 * document["resting_edge"], ":"),
    }
    for label, (value, style) in lines.items():
        axis.axhline(value, color="k", ls=style, lw=1, label=f"{label}: {value:.1f} mm")
    axis.set(xlim=(seeds[0] - 0.5, seeds[-1] + 0.5), xticks=seeds, ylim=(98, 114), xlabel="split", ylabel="edge [mm]")
    axis.legend(fontsize=8, loc="upper right")
    axis.set_title("edge: start -> fitted", fontsize=9)
    figure.savefig(path, dpi=110)
    plt.close(figure)
