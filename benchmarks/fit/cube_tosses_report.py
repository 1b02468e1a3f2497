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
    """Return what was done, and on what."""
    from benchmarks.fit.cube_tosses_data import SPHERES

    results, machine = document["results"], document["machine"]
    simulations = np.mean([r["simulations"] for r in results])
    lines = [
        "# Fitting a sphere cube to measured tosses",
        "",
        "Written by `benchmarks/fit/cube_tosses.py`; do not edit.",
        "",
        f"{document['tosses']} measured tosses of a cube on a board (ContactNets). Each fit sees"
        f" {len(results[0]['fitted_names'])} of them, drawn at random, and starts from {SPHERES} inset spheres of 4 mm"
        " radius that make up a cube whose edge is 5 % too small or too large; the other tosses judge it. The box in"
        " the scene, its markers and its normals are scaled along, so that nothing of the true size is in the fitted"
        " model. Contact parameters and gravity are the model's own and are not fitted.",
        "",
        f"Measured {document['date']} by `{document['command']}` on {machine['cpu']}, {machine['cores']} cores, python"
        f" {machine['python']}: {document['seconds']:.0f} s in all, for {len(results)} fits of {simulations:.0f}"
        f" simulations of {document['fit']['window']:g} s each; a fit takes"
        f" {np.mean([r['seconds']['cpu'] for r in results]):.0f} s of one processor.",
        "",
        "Errors are means over tosses, the fall with its 95 % bootstrap interval over tosses, beside two-sided paired"
        " tests over tosses. *True size* is the error of a cube of the published size, laid with spheres in the same"
        " way and not fitted.",
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
    """Return what the figures mean and what they do not."""
    true, scale, resting = 1e3 * document["edge"], length_scale(document), 1e3 * document["resting_edge"]
    lines = [
        "## Reading the figures",
        "",
        "- The edge is the distance between opposite faces, each taken as the mean over its four quadrants of the"
        " farthest reach of a sphere, mean of three axes. *Stands at* is twice the height at which the fitted cube"
        " comes to rest in simulation, mean of its six faces. Sphere friction: median, and the 10th and 90th"
        " percentile.",
        "- The windows are what a fit minimises: they start from the measured state and end before a difference at the"
        " start has grown.",
        "- Open loop, a whole toss says little of the size: the cube of published size is no better there than those of"
        f" a wrong one. With the published friction of {document['friction']} it slides too far, whatever its size, and"
        " after an impact that is a little off it tumbles onto another face. So where only positions are fitted, do"
        " not look for the effect in the open-loop errors; where friction is fitted too, the centre follows.",
        "- The larger of the two frictions counts in a contact, the board's or the sphere's: a fit can raise the"
        f" friction above {document['friction']} and not lower it.",
        "",
        "What the file itself says of the edge, from the tosses that were fitted:",
        "",
        f"- The centre of the resting cube lies {resting / 2:.2f} mm above the board: an edge of {resting:.1f} mm in"
        " the file's unit of length.",
        f"- Free fall has {document['free_fall']:.3f} +- {document['free_fall_error']:.3f} m/s^2 at the period of"
        f" {1e3 * PERIOD:.1f} ms, {scale * GRAVITY:.2f} at the nominal {RATE:.0f} Hz. So the file's metre measures"
        f" {1 / scale:.3f} m, and {true:.1f} mm are {true * scale:.1f} mm in the file's unit.",
    ]
    for friction, words in ((False, "positions alone"), (True, "positions and friction")):
        if results := [r for r in document["results"] if r["friction"] == friction]:
            edge = 1e3 * float(np.mean([r["edge"] for r in results]))
            lines.append(
                f"- Fitted by {words}, {edge:.1f} mm in the file's unit are {edge / scale:.1f} mm"
                f" ({100 * (edge / scale / true - 1):+.1f} % off)."
            )
    lines += [
        "",
        "A fit knows of no scale: it finds the size that the file shows, and what else the impacts show that the model"
        " lacks (restitution, the rounding of the real corners) acts on it together with the size.",
    ]
    return lines


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
