"""Page and figure of `real.py`."""

from __future__ import annotations

from typing import Any

from benchmarks.pages import FOLDER, machine_line, table, write_page
from concent_warp.comparison.units import p_value_text

NAME = "diagnose_real"
COLOURS = ("#1f5fa8", "#c8571b", "#3a8f5c", "#8250a0")
NULL_SAMPLES_P = 1 / 401
"""Smallest p-value of data recorded without it, from 400 samples."""


EXPERTS = {
    "tosses": (
        "sliding friction matters most; restitution changes little; the clock and length scale of the files are off by "
        "1 to 2 % (free fall at 9.49 m/s^2 in their units, a rest height of 51.2 mm for an edge of 104.8 mm); air drag "
        "and torsional friction do not help"
    ),
    "servo": (
        "Coulomb and viscous friction, then friction that grows with the load, which the authors of the data find to "
        "matter most for this servo; Stribeck friction and a delay help little"
    ),
}
"""What the publications on the data, and fits to them, say is missing."""
BARS = {"tosses": (12, 180.0), "servo": (4, 15.0)}
"""Recordings, and the time that their diagnosis may take on two cores [s]."""
SIGNIFICANT = 0.05


def write_report(result: dict[str, Any]) -> None:
    """Write the page and the figure from the data."""
    studies = [study for part in ("tosses", "servo") for study in result.get(part, {}).get("studies", [])]
    draw(studies)
    write_page(NAME, page(result, studies))


def page(result: dict[str, Any], studies: list[dict[str, Any]]) -> str:
    """Return the page."""
    text = """# Diagnoses of measured data

Written by `benchmarks/diagnose/real.py`; do not edit.

`python -m benchmarks.diagnose.real --data DATA`: diagnoses, with default settings, of tosses of a cube on a board
(ContactNets) and of logs of a servo that swings a payload (BAM, XL330). The cube's model is the published one; the
servo's has roughly known motor constants, no friction, and a drive strength that is fitted.

Each model is scored on recordings that the diagnosis does not see: other tosses, or the logs at the other gain of the
controller. A window, or a whole recording, starts from the measured state, corrected within the noise by its first
0.1 s; the error is the root mean square over the rest (0.2 s of tosses and 0.3 s of swings in windows), then over the
units (tosses, logs or windows of swings). Intervals are bootstrapped over the units; p is Wilcoxon's signed-rank test,
two-sided and not corrected. The *saved* model is the one that `concent diagnose --apply` writes. A *decoy* is an effect
that is fitted on top of it although the diagnosis did not accept it.

What the figures do not show: which effects are truly there. With the verdict "none of these" a part of the discrepancy
is unexplained. Windows of one log are not independent, so their p-values are too small; whole logs are few. Published
measurements of simple and double pendulums and of ball drops are not among the data. Other jobs ran on the machine.

![Error on held-out data after each addition](diagnose_real.png)
"""
    for part in ("tosses", "servo"):
        if part in result:
            text += f"\n{part.capitalize()}: {machine_line(result[part]['machine'])}\n"
    if studies:
        text += f"\n## Summary\n\n{summary(studies)}"
    for study in studies:
        text += section(study)
    return text


def summary(studies: list[dict[str, Any]]) -> str:
    """Return the table of all diagnoses."""
    head = ["diagnosed", "verdict", "effects", "held-out error as given, saved", "time, processor time", "bar"]
    rows = []
    for study in studies:
        diagnosis = study["diagnosis"]
        names = ", ".join(f["name"] for f in diagnosis["effects"] if f["accepted"]) or "none"
        errors = "; ".join(
            f"{j['name']} {c['before']:.3g}, {c['after']:.3g} {j['unit']}"
            for j, c in zip(study["judges"], study["steps"][-1]["from_first"], strict=True)
            if j["held_out"]
        )
        time = f"{study['seconds']:.0f}, {study['processor_seconds']:.0f} s, {study['jobs']} at a time"
        rows.append([study["title"], f"`{diagnosis['verdict']}`", names, errors, time, bar(study)])
    return table(head, rows)


def bar(study: dict[str, Any]) -> str:
    """Return the time that a diagnosis may take, and whether it does; processor time counts half on two cores."""
    count, most = BARS[study["part"]]
    if study["recordings"] != count:
        return ""
    took = study["seconds"] if study["jobs"] == 2 else study["processor_seconds"] / 2
    return f"{most:.0f} s: {'met' if took <= most else 'missed'}"


def section(study: dict[str, Any]) -> str:
    """Return the section of one diagnosis."""
    diagnosis = study["diagnosis"]
    ratios = ", ".join(f"{r:.1f}" for r in diagnosis["ratio"])
    text = f"""
## {study["title"][0].upper() + study["title"][1:]}

Verdict: `{diagnosis["verdict"]}`, after {study["seconds"]:.0f} s ({study["processor_seconds"]:.0f} s of processor time,
{study["jobs"]} at a time). Residual over noise of the model as given and after each change: {ratios}.
{100 * diagnosis["unexplained"]:.0f} % of the discrepancy remain unexplained.

An expert would say: {EXPERTS[study["part"]]}.

The diagnosis says:

{"".join(f"- {sentence}{chr(10)}" for sentence in study["sentences"])}
"""
    accepted = [f for f in diagnosis["effects"] if f["accepted"]]
    if accepted:
        head = ["effect", "parameters, 95 % interval", "cross-validated gain", "p"]
        text += "Accepted, with the values of the saved model:\n\n"
        text += table(head, [[f["name"], parameters(f), gain(f), p_text(f)] for f in accepted])
    else:
        text += "Accepted: none.\n"
    for names in diagnosis["groups"]:
        if len(names) > 1:
            text += f"\nThe data do not distinguish {names[0]} from {', '.join(names[1:])}.\n"
    text += f"\n{saved_sentence(study)}\n"
    for k, judge in enumerate(study["judges"]):
        text += f"\n{judge['name']} [{judge['unit']}], {judge['units']} units:\n\n"
        text += steps(study["steps"], k)
    if study["decoys"]:
        text += "\nDecoys, fitted to the diagnosed data on top of the saved model:\n\n"
        head = ["decoy", *(j["name"] for j in study["judges"]), "fitted"]
        text += table(head, [decoy(d, study) for d in study["decoys"]])
    else:
        text += "\nDecoys were left out of this run.\n"
    if len(study["ladder"]) > 1:
        text += "\nEffects in the order of the literature, without a selection, fitted to the same data:\n"
        for k, judge in enumerate(study["judges"]):
            text += f"\n{judge['name']} [{judge['unit']}]:\n\n" + steps(study["ladder"], k)
        fitted = "; ".join(f"{name} {value:.3g}" for name, value in study["ladder"][-1]["values"].items())
        text += f"\nValues of the last: {fitted}.\n"
    else:
        text += "\nEffects in the order of the literature were left out of this run.\n"
    rejected = [f for f in diagnosis["effects"] if not f["accepted"]]
    if rejected:
        text += "\nFitted and not accepted: "
        text += "; ".join(f"{f['name']} (step {f['step'] + 1}: {f.get('reason', '')})" for f in rejected) + ".\n"
    return text


def saved_sentence(study: dict[str, Any]) -> str:
    """Return whether the saved model is better or worse than the one as given on data that were held out."""
    said: dict[str, list[str]] = {"worse": [], "no different": [], "better": []}
    for judge, change in zip(study["judges"], study["steps"][-1]["from_first"], strict=True):
        if judge["held_out"]:
            said[judgement(change)].append(f"{judge['name']} ({share(change)})")
    words = [f"{word} in {'; '.join(names)}" for word, names in said.items() if names]
    return f"On held-out data the saved model is {', '.join(words)}: fall of the error from that of the model as given."


def judgement(change: dict[str, Any]) -> str:
    """Return "better" or "worse" where interval or test exclude that an error stays, else "no different"."""
    low, high = change["low"], change["high"]
    tested = change["p"] < SIGNIFICANT and change["better"] != 0.5
    if high < 0 or (tested and change["better"] < 0.5 and change["fall"] < 0):
        return "worse"
    return "better" if low > 0 or (tested and change["better"] > 0.5 and change["fall"] > 0) else "no different"


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
        names = ["as given", *map(str, range(1, len(study["steps"]) - 1)), "saved"][: len(study["steps"])]
        for k, judge in enumerate(study["judges"]):
            changes = [row["from_first"][k] for row in study["steps"]]
            first = changes[0]["before"]
            value = [c["after"] / first for c in changes]
            low, high = ([1 - c[end] for c in changes] for end in ("high", "low"))
            label = f"{judge['name']} ({first:.3g} {judge['unit']} at first)"
            axis.plot(range(len(names)), value, "o-", color=COLOURS[k], label=label)
            axis.fill_between(range(len(names)), low, high, color=COLOURS[k], alpha=0.15, linewidth=0)
        axis.set_xticks(range(len(names)), names)
        axis.set_xlabel("model after each change, as in the tables")
        axis.set_ylim(0, max(1.1, axis.get_ylim()[1]))
        axis.set_title(study["title"], fontsize=10)
        axis.grid(axis="y", alpha=0.3)
        axis.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.16))
    axes[0, 0].set_ylabel("error over that as given")
    figure.tight_layout()
    figure.savefig(FOLDER / "diagnose_real.png", dpi=110)
    plt.close(figure)
