"""The page of the hidden-effect benchmark: shares with intervals, a table by effect, the confusions as a picture."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from scipy.stats import norm

from benchmarks.diagnose.hidden_effects_data import BEST, cases
from benchmarks.pages import FOLDER, data_path, read_data, table
from concent_warp.files import write_text

NAME = "hidden_effects"
FLOOR = 1.3
"""Residual over noise at which a model has reached the noise."""
EQUAL_RIGS = ("drop", "tumble")
"""Rigs in which Reality, with nothing hidden, is the nominal model to the bit: no drives, the same step and options."""
Row = dict[str, Any]


def write_report(rows: Sequence[Row], total: int, host: str) -> None:
    """Write data, picture and page of the whole benchmark."""
    limits = detection_limits(rows)
    kept = {"host": host, "rows": [slim(row) for row in rows], "detection_limits": limits}
    write_kept({**kept, "again": (read_data(NAME) or {}).get("again")}, total)


def write_again(rows: Sequence[Row], total: int, host: str) -> None:
    """Write the page with a run on other seeds, in place of an older one."""
    write_kept({**read_data(NAME), "again": {"host": host, "rows": [slim(row) for row in rows]}}, total)


def write_kept(kept: dict[str, Any], total: int) -> None:
    """Write what is kept, picture and page."""
    data_path(NAME).parent.mkdir(parents=True, exist_ok=True)
    write_text(data_path(NAME), json.dumps(kept, indent=1))
    confusion(kept["rows"])
    text = page(kept["rows"], total, kept["host"], kept["detection_limits"])
    if again := kept.get("again"):
        text += other_seeds(again["rows"], total, again["host"])
    write_text(FOLDER / f"{NAME}.md", text)


def other_seeds(rows: Sequence[Row], total: int, host: str) -> str:
    """Return the section of a run on other seeds."""
    wrong = [
        [f"`{r['name']}`", r.get("verdict", "error"), named(r)]
        for r in sorted(rows, key=lambda r: r["name"])
        if r["kind"] == "single" and not first_right(r)
    ]
    return f"""
## Other seeds

{host} {len(rows)} of {total} data sets.

{table(["", "bar", "share", "95 % interval", "data sets"], all_shares(rows))}
Where another effect was named first:

{table(["data", "verdict", "named"], wrong)}"""


def slim(row: Row) -> Row:
    """Return a row without what the page does not show."""
    kept = {k: v for k, v in row.items() if k not in ("detectable", "where", "versions", "issues")}
    kept["effects"] = [e for e in row.get("effects", ()) if e["accepted"]]
    return kept


def detection_limits(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the smallest size of each effect that the search would name, by rig, from data that hide nothing."""
    sizes: dict[tuple[str, str, str, str], list[float]] = {}
    for row in rows:
        for found in row.get("detectable", ()) if row["kind"] == "null" else ():
            parameter = found["parameter"].split("[")[0]
            sizes.setdefault((found["name"], row["rig"], parameter, found["unit"]), []).append(found["size"])
    return [
        {
            "effect": effect,
            "rig": rig,
            "parameter": parameter,
            "unit": unit,
            "size": float(np.median(of)),
            "sets": len(of),
        }
        for (effect, rig, parameter, unit), of in sorted(sizes.items())
    ]


def base(name: str) -> str:
    """Return the name of an effect without its target."""
    return name.split("(")[0]


def accepted(row: Row) -> list[str]:
    """Return the effects that were accepted, in order."""
    return [base(e["name"]) for e in row.get("effects", ()) if e["accepted"]]


def groups(row: Row) -> list[set[str]]:
    """Return the groups of names that the data do not distinguish."""
    return [{base(name) for name in group} for group in row.get("groups", ())]


def first_right(row: Row) -> bool:
    """Return whether the hidden effect is the first that is named."""
    return accepted(row)[:1] == [row["truth"][0]["name"]]


def exactly_right(row: Row) -> bool:
    """Return whether the hidden effect is named, alone and without alternatives."""
    return first_right(row) and groups(row) == [{row["truth"][0]["name"]}]


def in_group(row: Row) -> bool:
    """Return whether the hidden effect is among the first ones named."""
    return bool(groups(row)) and row["truth"][0]["name"] in groups(row)[0]


def both_found(row: Row) -> bool:
    """Return whether each of several hidden effects is among those named, in groups of their own."""
    truth = {t["name"] for t in row["truth"]}
    left = groups(row)
    for name in sorted(truth):
        match = next((g for g in left if name in g), None)
        if match is None:
            return False
        left.remove(match)
    return True


def alarm(row: Row) -> bool:
    """Return whether an effect was named, or one said to be missing."""
    return row.get("verdict") != "none_needed"


def none_of_these(row: Row) -> bool:
    """Return whether something was said to be missing that no effect explains."""
    return row.get("verdict") == "none_of_these"


def at_floor(row: Row) -> bool:
    """Return whether the last model's error is within `FLOOR` times the noise."""
    return bool(row.get("ratio")) and row["ratio"][-1] <= FLOOR


def coverage(rows: Iterable[Row]) -> list[bool]:
    """Return, for each true parameter of an effect that was rightly named first, whether its interval covers it."""
    hits = []
    for row in rows:
        if not first_right(row):
            continue
        truth = row["truth"][0]["parameters"]
        found = next(e for e in row["effects"] if e["accepted"])
        for p in found["parameters"]:
            if p["name"] in truth and p["interval"][0] is not None and p["interval"][1] is not None:
                hits.append(p["interval"][0] <= truth[p["name"]] <= p["interval"][1])
    return hits


def wilson(hits: Sequence[bool]) -> tuple[float, float, float]:
    """Return the share of hits and its 95 % interval (Wilson, J. Am. Stat. Assoc. 22, 1927)."""
    n = len(hits)
    if not n:
        return np.nan, np.nan, np.nan
    z, share = float(norm.ppf(0.975)), sum(hits) / n
    centre = (share + z * z / (2 * n)) / (1 + z * z / n)
    reach = z * np.sqrt(share * (1 - share) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return share, float(centre - reach), float(centre + reach)


def figure(title: str, bar: str, hits: Sequence[bool]) -> list[str]:
    """Return a row of the table of shares."""
    share, low, high = wilson(hits)
    if not len(hits):
        return [title, bar, "-", "-", "0"]
    return [title, bar, f"{100 * share:.0f} %", f"{100 * low:.0f}-{100 * high:.0f} %", str(len(hits))]


def all_shares(rows: Sequence[Row]) -> list[list[str]]:
    """Return the table of shares."""
    single = [r for r in rows if r["kind"] == "single"]
    null = [r for r in rows if r["kind"] == "null"]
    outside = [r for r in rows if r["kind"] == "outside"]
    pair = [r for r in rows if r["kind"] == "pair"]
    right = [r for r in single if first_right(r)]

    def over(of: Sequence[Row], hit: Callable[[Row], bool]) -> list[bool]:
        return [hit(r) for r in of]

    equal = [r for r in single if r["rig"] in EQUAL_RIGS]
    others = [r for r in single if r["rig"] not in EQUAL_RIGS]
    return [
        figure("right effect named first", ">= 90 %", over(single, first_right)),
        figure(
            f"- rigs whose Reality equals the nominal model ({', '.join(EQUAL_RIGS)})", "", over(equal, first_right)
        ),
        figure("- other rigs", "", over(others, first_right)),
        figure("exactly the right effect named and nothing else", "", over(single, exactly_right)),
        figure("right effect in the group named first", ">= 97 %", over(single, in_group)),
        figure("false alarm, nothing hidden", "<= 5 %", over(null, alarm)),
        figure('"none of these", effect outside the library', ">= 80 %", over(outside, none_of_these)),
        figure("both found, two effects at once", ">= 75 %", over(pair, both_found)),
        figure(f"error within {FLOOR} x noise after adding the right effect", "", over(right, at_floor)),
        figure("true parameter within its 95 % interval", "90-99 %", coverage(single)),
    ]


def page(rows: Sequence[Row], total: int, host: str, limits: Sequence[dict[str, Any]]) -> str:
    """Return the page."""
    single = [r for r in rows if r["kind"] == "single"]
    seconds = np.array([r["seconds"] for r in rows]) if rows else np.zeros(1)
    planned = Counter(case.rig for case in cases())
    by_rig = []
    for rig in dict.fromkeys(r["rig"] for r in rows):
        mine = np.array([r["seconds"] for r in rows if r["rig"] == rig])
        by_rig.append([rig, f"{len(mine)} of {planned[rig]}", f"{np.median(mine):.0f}", f"{mine.max():.0f}"])
    effects = []
    for name in dict.fromkeys(r["truth"][0]["name"] for r in single):
        mine = [r for r in single if r["truth"][0]["name"] == name]
        others = sorted(
            {accepted(r)[0] if accepted(r) else r.get("verdict", "error") for r in mine if not first_right(r)}
        )
        effects.append(
            [
                f"`{name}`",
                str(len(mine)),
                str(sum(map(first_right, mine))),
                str(sum(map(in_group, mine))),
                ", ".join(others) or "-",
            ]
        )
    other = [
        [f"`{r['name']}`", r.get("verdict", "error"), named(r), " -> ".join(f"{x:.2f}" for x in r.get("ratio", ()))]
        for r in sorted(rows, key=lambda r: (r["kind"], r["name"]))
        if r["kind"] in ("outside", "pair") or (r["kind"] == "null" and alarm(r))
    ]
    failed = [r for r in rows if "error" in r]
    smallest = [
        [f"`{f['effect']}`", f["rig"], f"{f['parameter']} {f['size']:.2g} {f['unit'].replace('-', '')}".rstrip()]
        for f in limits
        if BEST.get(f["effect"]) == f["rig"]
    ]
    return f"""# Hidden effects

`python -m benchmarks.diagnose.hidden_effects`: how often `concent diagnose` names the effect that is hidden in a
recording. The recordings are made in Reality, which implements each effect by other means than the library;
`benchmarks/diagnose/hidden_effects_data.py` lists all {total}.

{host} {len(rows)} of {total} data sets are finished, {len(failed)} ended in an error; the
{total - len(rows)} others count in no share below. {seconds.sum() / 3600:.1f} hours of one core in all.

What the figures do not show: measured data ([diagnoses of them](diagnose_real.md)), and more than two effects at a
time. Slow data sets are missing more often than others; the table of times has the counts by rig.

{table(["", "bar", "share", "95 % interval", "data sets"], all_shares(rows))}
Intervals are Wilson's. The *bar* is the required share. Effects have two magnitudes: *middle* leaves a residual of
about four standard deviations of the noise, *large* two to three times that.

## By effect

{table(["effect", "data sets", "first", "in the group", "named instead"], effects)}
![which effect was named for which](hidden_effects.png)

## Outside the library, two at once, false alarms

The name of the data has the hidden effects. Groups are effects that the data do not distinguish, in the order of the
additions; the ratio is that of residual to noise, for the nominal model and after each addition.

{table(["data", "verdict", "named", "ratio"], other)}
## Detection limits

The smallest size of each effect that the search would name in half of all cases: the median over the data sets of its
rig in which nothing is hidden. `detectable` in the output of `concent diagnose` gives it for any recording.

{table(["effect", "rig", "smallest size"], smallest)}
## Time

Seconds on one core of a shared machine for a whole diagnosis, all candidates and the calibration included.

{table(["rig", "data sets", "median [s]", "longest [s]"], by_rig)}"""


def named(row: Row) -> str:
    """Return the groups that were named, in words."""
    return ", then ".join(" or ".join(sorted(group)) for group in groups(row)) or "-"


def confusion(rows: Sequence[Row]) -> None:
    """Draw which effect was named first where which was hidden."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    truths: dict[str, list[str]] = {}
    for r in rows:
        if r["kind"] in ("single", "null", "outside"):
            truth = r["truth"][0]["name"] if r["truth"] else "(nothing)"
            named = accepted(r)[0] if accepted(r) else r.get("verdict", "error")
            if none_of_these(r):
                named = "none_of_these"
            truths.setdefault(truth, []).append(named)
    across = [*truths, *sorted({n for named in truths.values() for n in named} - set(truths))]
    counts = np.zeros((len(truths), len(across)))
    for i, named in enumerate(truths.values()):
        for n in named:
            counts[i, across.index(n)] += 1 / len(named)
    figure_, axes = plt.subplots(figsize=(0.24 * len(across) + 3.2, 0.24 * len(truths) + 2.8), layout="constrained")
    axes.imshow(counts, cmap="Blues", vmin=0, vmax=1)
    axes.set_xticks(range(len(across)), across, rotation=90, fontsize=7)
    axes.set_yticks(range(len(truths)), list(truths), fontsize=7)
    axes.set_xlabel("named first")
    axes.set_ylabel("hidden")
    for i, j in zip(*np.nonzero(counts), strict=True):
        colour = "white" if counts[i, j] > 0.6 else "black"
        axes.text(j, i, f"{100 * counts[i, j]:.0f}", ha="center", va="center", fontsize=5, color=colour)
    figure_.savefig(FOLDER / f"{NAME}.png", dpi=150)
    plt.close(figure_)
