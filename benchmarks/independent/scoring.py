"""Scores of the results: what counts as right.

An effect counts by its name in the library. No effect stands for another one: there is no list of equivalents. Where
the accepted finding has the hidden effect's name, it must also concern one of its targets. Sets whose diagnosis took
too long or failed are wrong in every figure, except in those over saved models and over fitted parameters, which do not
exist there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from scipy.stats import norm

from benchmarks.independent.data_set import ENGINES, World

Row = dict[str, Any]
MAX_GROUP = 2
"""Most effects in a group that counts as naming one."""
LIBRARY_KINDS = ("single", "pair", "geometry")
"""Kinds of sets that hide effects of the library only."""


def base(name: str) -> str:
    """Return the name of an effect without its target."""
    return name.split("(")[0]


def ended(row: Row) -> bool:
    """Return whether the diagnosis came to a result in its time."""
    return "error" not in row and "verdict" in row


def settled(row: Row) -> bool:
    """Return whether the diagnosis came to a result in its time that it does not call unsettled."""
    return ended(row) and row["verdict"] != "unsettled"


def accepted(row: Row) -> list[Row]:
    """Return the accepted findings, in order."""
    return [e for e in row.get("effects", ()) if e["accepted"]]


def groups(row: Row) -> list[set[str]]:
    """Return the names that the data do not distinguish, a set for each addition."""
    return [{base(name) for name in group} for group in row.get("groups", ())] if ended(row) else []


def names_it(row: Row, step: int, truth: Row, most: float = MAX_GROUP) -> bool:
    """Return whether an addition names a hidden effect, alone or in a group of at most `most`."""
    group, found = groups(row)[step], accepted(row)
    if truth["name"] not in group or len(group) > most:
        return False
    if step >= len(found) or base(found[step]["name"]) != truth["name"]:
        return True
    here, there = set(found[step].get("target", ())), set(truth.get("target", ()))
    return not here or not there or bool(here & there)


def matched(row: Row, most: float = MAX_GROUP) -> int:
    """Return how many hidden effects are named, each by an addition of its own: the most that can be."""

    def best(left: Sequence[Row], steps: frozenset[int]) -> int:
        if not left:
            return 0
        rest = best(left[1:], steps)
        taken = [best(left[1:], steps - {k}) + 1 for k in steps if names_it(row, k, left[0], most)]
        return max([rest, *taken])

    return best(row.get("truth", ()), frozenset(range(len(groups(row)))))


def exactly_right(row: Row) -> bool:
    """Return whether the hidden effects are named and nothing else, each alone or in a group of at most two.

    A verdict that something else is missing besides is not exactly right.
    """
    truth = row.get("truth", ())
    said = row.get("verdict") in ("effect", "group")
    return bool(ended(row) and said and truth and len(groups(row)) == len(truth) == matched(row))


def right_but_more(row: Row) -> bool:
    """Return whether it would be exactly right if the verdict did not say that something else is missing, too."""
    return row.get("verdict") == "none_of_these" and exactly_right({**row, "verdict": "effect"})


def in_first_group(row: Row) -> bool:
    """Return whether a hidden effect is in the first group, however large."""
    return bool(groups(row)) and any(names_it(row, 0, t, np.inf) for t in row.get("truth", ()))


def false_alarm(row: Row) -> bool:
    """Return whether an effect was named, or something said to be missing, or nothing said in time."""
    return not ended(row) or row["verdict"] != "none_needed"


def none_of_these(row: Row) -> bool:
    """Return whether something was said to be missing that no effect explains."""
    return ended(row) and row["verdict"] == "none_of_these"


def covered(rows: Iterable[Row]) -> list[bool]:
    """Return, for each true parameter of a hidden effect that was accepted, whether its 95 % interval has it."""
    hits = []
    for row in rows:
        for truth in row.get("truth", ()):
            found = next((e for e in accepted(row) if base(e["name"]) == truth["name"]), None)
            for p in found["parameters"] if found is not None else ():
                low, high = p["interval"]
                if p["name"] in truth["parameters"] and low is not None and high is not None:
                    hits.append(bool(low <= truth["parameters"][p["name"]] <= high))
    return hits


def never_worse(rows: Iterable[Row]) -> list[bool]:
    """Return, for each saved model with added effects, whether its held-out error is not above the one before.

    A saved model that cannot be compared is worse.
    """
    hits = []
    for row in rows:
        held_out = row.get("held_out")
        if held_out and held_out["changed"]:
            hits.append("error" not in held_out and bool(held_out["after"] <= held_out["before"]))
    return hits


def wilson(hits: Sequence[bool]) -> tuple[float, float, float]:
    """Return the share of hits and its 95 % interval (Wilson, J. Am. Stat. Assoc. 22, 1927)."""
    n = len(hits)
    if not n:
        return np.nan, np.nan, np.nan
    z, share = float(norm.ppf(0.975)), sum(hits) / n
    centre = (share + z * z / (2 * n)) / (1 + z * z / n)
    reach = z * np.sqrt(share * (1 - share) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return share, float(max(centre - reach, 0.0)), float(min(centre + reach, 1.0))


def figure(hits: Sequence[bool]) -> str:
    """Return a share in words: per cent, interval and counts."""
    if not len(hits):
        return "-"
    share, low, high = wilson(hits)
    return f"{100 * share:.0f} % [{100 * low:.0f}-{100 * high:.0f}] ({sum(hits)} of {len(hits)})"


Measure = Callable[[Sequence[Row]], list[bool]]


def over(hit: Callable[[Row], bool], *kinds: str, **fields: Any) -> Measure:
    """Return the measure of a score over the sets of some kinds whose entries have the given values."""

    def measure(rows: Sequence[Row]) -> list[bool]:
        return [hit(r) for r in rows if r["kind"] in kinds and all(r[name] == value for name, value in fields.items())]

    return measure


BARS: tuple[tuple[World, bool, tuple[str, str]], ...] = (
    ("mujoco", True, (">= 88 %", ">= 83 %")),
    ("mujoco", False, (">= 83 %", ">= 78 %")),
    ("drake", True, (">= 83 %", ">= 78 %")),
    ("drake", False, (">= 78 %", ">= 73 %")),
    ("bullet", True, ("", "")),
    ("bullet", False, ("", "")),
)
"""World, whether noise is stated, bars of sets with one effect: of development sets and of locked ones."""
FIGURES: tuple[tuple[str, str, str, Measure], ...] = (
    *(
        (
            f"exactly right, {ENGINES[world]}, noise {'stated' if stated else 'not stated'}",
            bars[0],
            bars[1],
            over(exactly_right, "single", world=world, noise_stated=stated),
        )
        for world, stated, bars in BARS
    ),
    ("right one in the first group", ">= 95 %", ">= 93 %", over(in_first_group, "single")),
    ("nothing hidden, false alarms", "<= 3 %", "<= 5 %", over(false_alarm, "null")),
    ('outside the library, "none of these"', ">= 85 %", ">= 80 %", over(none_of_these, "outside")),
    ("two effects, both and nothing else", ">= 70 %", ">= 65 %", over(exactly_right, "pair")),
    ("contact geometry, exactly right", "", "", over(exactly_right, "geometry")),
    ("every set with effects of the library, exactly right", "", "", over(exactly_right, *LIBRARY_KINDS)),
    ("- right, but more is said to be missing", "", "", over(right_but_more, *LIBRARY_KINDS)),
    ("true value in its 95 % interval", "90-99 %", "88-99 %", covered),
    ("- of settled diagnoses", "", "", lambda rows: covered(filter(settled, rows))),
    ("held-out error of the saved model never above", "100 %", "100 %", never_worse),
    ("- of settled ones", "", "", lambda rows: never_worse(filter(settled, rows))),
    ("came to a settled result in time", "", "", over(settled, "null", "outside", *LIBRARY_KINDS)),
)
"""Title, bar of the development sets, bar of the locked sets, measure."""


def score(row: Row) -> bool:
    """Return whether a set is right by the measure of its kind."""
    if row["kind"] == "null":
        return not false_alarm(row)
    return none_of_these(row) if row["kind"] == "outside" else exactly_right(row)


def named(row: Row) -> str:
    """Return the groups that were named, in words."""
    return ", then ".join(" or ".join(sorted(group)) for group in groups(row)) or "-"


def line(row: Row) -> str:
    """Return a result in one line."""
    mark = "ok   " if score(row) else "WRONG"
    if "error" in row:
        return f"{mark} {row['name']:50s} {row['error'].strip().splitlines()[-1][:90]}  {row['seconds']:.0f} s"
    ratio = "->".join(f"{r:.2f}" for r in row["ratio"])
    return f"{mark} {row['name']:50s} {row['verdict']:13s} {named(row)}  {ratio}  {row['seconds']:.0f} s"
