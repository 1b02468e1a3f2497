"""Page and figure of `real.py`."""

from __future__ import annotations

from typing import Any

from benchmarks.pages import FOLDER, machine_line, table, write_page
from concent_warp.comparison.units import p_value_text

NAME = "diagnose_real"
COLOURS = ("#1f5fa8", "#c8571b", "#3a8f5c")
NULL_SAMPLES_P = 1 / 401
"""Smallest p-value of data recorded without it, from 400 samples."""


def write_report(result: dict[str, Any]) -> None:
    """Write the page and the figure from the data."""
    studies = [study for part in ("tosses", "servo") for study in result.get(part, {}).get("studies", [])]
    draw(studies)
    write_page(NAME, page(result, studies))


def page(result: dict[str, Any], studies: list[dict[str, Any]]) -> str:
    """Return the page."""
    text = """# Diagnoses of measured data

Written by `benchmarks/diagnose/real.py`; do not edit.

`python -m benchmarks.diagnose.real --data DATA`: diagnoses, with default settings (at most two additions for tosses),
of tosses of a cube on a board (ContactNets) and of logs of a servo that swings a payload (BAM, XL330). The cube's model
is the published one; the servo's has roughly known motor constants, no friction, and a drive strength that is fitted.

Each step is scored on recordings that the diagnosis does not see: other tosses, or the logs at the other gain of the
controller. A window starts from the measured state, corrected within the noise by its first 0.1 s; the error is the
root mean square over the rest of the window (0.2 s of tosses, 0.3 s of swings), then over the units (tosses, or windows
of swings). Intervals are bootstrapped over the units; p is Wilcoxon's signed-rank test, two-sided and not corrected. A
*decoy* is an effect that is fitted on top of the final model although the diagnosis did not accept it.

What the figures do not show: which effects are truly there. With the verdict "none of these" a
part of the discrepancy is unexplained. Windows of one log are not independent, so their p-values are too small. Two
rules for the noise level (a lower bound from the quietest stretches, the resolution of the encoder) were chosen on
these data. Other jobs ran on the machine.

![Error on held-out data after each addition](diagnose_real.png)
"""
    for part in ("tosses", "servo"):
        if part in result:
            spent, remark = result[part]["seconds"], result[part].get("remark", "")
            line = f"{machine_line(result[part]['machine'])} The {part} took {spent:.0f} s in all. {remark}"
            text += f"\n{line.rstrip()}\n"
    for study in studies:
        text += section(study)
    return text


def section(study: dict[str, Any]) -> str:
    """Return the section of one diagnosis."""
    diagnosis = study["diagnosis"]
    ratios = ", ".join(f"{r:.1f}" for r in diagnosis["ratio"])
    text = f"""
## {study["title"][0].upper() + study["title"][1:]}

Verdict: `{diagnosis["verdict"]}`, after {study["seconds"]:.0f} s. Residual over noise, before and after each addition:
{ratios}. {100 * diagnosis["unexplained"]:.0f} % of the discrepancy remain unexplained.

Accepted, in this order:

"""
    head = ["effect", "parameters, 95 % interval", "cross-validated gain", "p"]
    accepted = [f for f in diagnosis["effects"] if f["accepted"]]
    text += table(head, [[f["name"], parameters(f), gain(f), p_text(f)] for f in accepted])
    for names in diagnosis["groups"]:
        if len(names) > 1:
            text += f"\nThe data do not distinguish {names[0]} from {', '.join(names[1:])}.\n"
    for k, judge in enumerate(study["judges"]):
        text += f"\n{judge['name']} [{judge['unit']}], {judge['units']} units:\n\n"
        text += steps(study["steps"], k)
    text += "\nDecoys, fitted to the diagnosed data on top of the final model, on held-out data:\n\n"
    text += table(
        ["decoy", *(j["name"] for j in study["judges"]), "fitted"], [decoy(d, study) for d in study["decoys"]]
    )
    if "ladder" in study:
        text += "\nServo effects in the order of the literature, without a selection:\n"
        for k, judge in enumerate(study["judges"]):
            text += f"\n{judge['name']} [{judge['unit']}]:\n\n" + steps(study["ladder"], k)
    rejected = [f for f in diagnosis["effects"] if not f["accepted"]]
    if rejected:
        text += "\nFitted and not accepted: "
        text += "; ".join(f"{f['name']} (step {f['step'] + 1}: {f.get('reason', '')})" for f in rejected) + ".\n"
    return text


def p_text(finding: dict[str, Any]) -> str:
    """Return the p-value of a finding as the cell of a table."""
    return p_value_text(finding["p"], finding.get("p_smallest", NULL_SAMPLES_P)).removeprefix("p ").removeprefix("= ")


def steps(rows: list[dict[str, Any]], k: int) -> str:
    """Return the table of errors, step by step, of one judge."""
    head = ["model", "error", "fall from the first", "fall from the one before", "better units", "p"]
    cells = []
    for i, row in enumerate(rows):
        first, last = row["from_first"][k], row["from_before"][k]
        if i == 0 and abs(first["fall"]) < 1e-12:
            cells.append([row["name"], f"{first['after']:.2f}", "", "", "", ""])
        else:
            better = f"{100 * last['better']:.0f} %"
            cells.append([row["name"], f"{first['after']:.2f}", share(first), share(last), better, f"{last['p']:.1g}"])
    return table(head, cells)


def share(change: dict[str, Any]) -> str:
    """Return a fall with its interval."""
    return f"{100 * change['fall']:.1f} % ({100 * change['low']:.1f} to {100 * change['high']:.1f})"


def decoy(found: dict[str, Any], study: dict[str, Any]) -> list[str]:
    """Return the row of a decoy."""
    if found["accepted"]:
        return [found["name"], *("accepted" for _ in study["judges"]), ""]
    values = ", ".join(f"{name.split('.')[1]} {value:.3g}" for name, value in found["values"].items())
    return [found["name"], *(f"{share(c)}, p {c['p']:.1g}" for c in found["changes"]), values]


def parameters(finding: dict[str, Any]) -> str:
    """Return the parameters of an effect with their intervals."""
    said = []
    for p in finding["parameters"]:
        low, high = (("-" if v is None else f"{v:.3g}") for v in p["interval"])
        said.append(f"{p['name']} {p['value']:.3g} [{low}, {high}] {p['unit']}")
    return "; ".join(said)


def gain(finding: dict[str, Any]) -> str:
    """Return the gain of an effect with its interval."""
    low, high = finding["gain"]["interval"]
    return f"{100 * finding['gain']['value']:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def draw(studies: list[dict[str, Any]]) -> None:
    """Draw the error on held-out data after each addition, one panel a diagnosis."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    if not studies:
        return
    figure, axes = plt.subplots(1, len(studies), figsize=(5.2 * len(studies), 4.2), squeeze=False)
    for axis, study in zip(axes[0], studies, strict=True):
        names = [row["name"] for row in study["steps"]]
        for k, judge in enumerate(study["judges"]):
            changes = [row["from_first"][k] for row in study["steps"]]
            first = changes[0]["before"]
            value = [c["after"] / first for c in changes]
            low, high = ([1 - c[end] for c in changes] for end in ("high", "low"))
            label = f"{judge['name']} ({first:.3g} {judge['unit']} at first)"
            axis.plot(range(len(names)), value, "o-", color=COLOURS[k], label=label)
            axis.fill_between(range(len(names)), low, high, color=COLOURS[k], alpha=0.15, linewidth=0)
        axis.set_xticks(range(len(names)), names, rotation=25, ha="right")
        axis.set_ylim(0, max(1.1, axis.get_ylim()[1]))
        axis.set_title(study["title"], fontsize=10)
        axis.grid(axis="y", alpha=0.3)
        axis.legend(fontsize=8, loc="lower left")
    axes[0, 0].set_ylabel("error, as a share of the first model's")
    figure.tight_layout()
    figure.savefig(FOLDER / "diagnose_real.png", dpi=110)
    plt.close(figure)
