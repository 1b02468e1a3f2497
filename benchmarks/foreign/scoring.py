"""What counts as a right answer to a foreign log, and the page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import permutations
from typing import Any, Literal, get_args

import numpy as np

from benchmarks.foreign.log import KINDS
from benchmarks.independent.scoring import MAX_GROUP, ended, groups, settled
from benchmarks.pages import table, write_data, write_page
from concent_warp.train.trials.evaluate import wilson

Row = dict[str, Any]
Score = Literal["right", "unsettled", "wrong"]
NAME = "foreign"
KEPT = (
    "name", "machine", "kind", "accepted", "locked", "noise_stated", "verdict", "groups", "ratio", "unsettled", "error",
    "seconds", "processor_seconds", "commit",
)  # fmt: skip
"""What the page's data keep of a result."""
TITLES = {
    "null": "nothing hidden: no discrepancy",
    "single": "one effect: it alone",
    "pair": "two effects: both and nothing else",
    "outside": "a cause that the library lacks: none of these",
}
ABOUT = """\
`python -m benchmarks.foreign` diagnoses logs as a laboratory has them: an MJCF model and CSV files. The machines are
simulated by equations of motion that are written here, machine by machine, with friction and contacts of their own
form, and not by MuJoCo, Drake or Bullet. They were written by roboticists' rules without any diagnosis: which names
count as right, and by how much masses, lengths, gains (0.3 to 2 %), friction and damping (up to 4 %) differ from the
model, also where nothing is hidden, was fixed before; lengths are exact where bodies touch or fly.
Sizes of hidden effects were set by the residuals that `concent compare` shows. Noise is stated in about half of the
logs.

An answer is right where it names each hidden effect by a name that counts, alone or in a group of at most two, and
nothing else; where nothing is hidden, if it says that nothing is missing; where the library lacks the cause, if it says
`none_of_these`. What is not settled in its time counts as wrong.

A half of the machines, chosen by a hash of their names, is locked: no rule of the method was chosen by looking at their
answers, which are counted and not read. Of the development logs 25 had been diagnosed once before, which showed a
crash; no rule came from them either. The answers of `air_puck` were read on 2026-11-29, after its first diagnosis (1 of
5 right), and showed two faults that are mended: its rows are no longer blind. `disc_push` was given a name whose hash
makes it a development machine. Square brackets have Wilson's 95 % intervals over logs; logs of a machine
are alike, so that they are too narrow.
"""


def score(row: Row) -> Score:
    """Return whether an answer is right, and where it is not, whether it was settled."""
    if not settled(row):
        return "unsettled"
    kind, found, accepted = row["kind"], groups(row), row["accepted"]
    if kind in ("null", "outside"):
        return "right" if row["verdict"] == ("none_needed" if kind == "null" else "none_of_these") else "wrong"
    if row["verdict"] not in ("effect", "group") or len(found) != len(accepted):
        return "wrong"
    fits = any(
        all(len(group) <= MAX_GROUP and group & set(names) for group, names in zip(found, order, strict=True))
        for order in permutations(accepted)
    )
    return "right" if fits else "wrong"


def said(row: Row) -> str:
    """Return an answer in a few words."""
    if not ended(row):
        return "time-out" if row["error"] == "time-out" else "error"
    named = ", then ".join(" or ".join(group) for group in row["groups"])
    return f"{row['verdict']}: {named}" if named else str(row["verdict"])


def line(row: Row) -> str:
    """Return a result in one line."""
    ratios = " -> ".join(f"{ratio:.2f}" for ratio in row.get("ratio", ()))
    return f"{score(row):9s} {row['name']:42s} {row['seconds']:5.0f} s  {said(row)}  {ratios}"


def write(rows: Sequence[Row], host: str, total: int) -> None:
    """Write the page and its data.

    Args:
        rows: Results.
        host: Where they were measured, in words.
        total: Logs that there are.
    """
    kept = [{key: row[key] for key in KEPT if key in row} for row in rows]
    write_data(NAME, {"host": host, "rows": kept, "total": total})
    write_page(NAME, page(rows, host, total))


def page(rows: Sequence[Row], host: str, total: int) -> str:
    """Return the page; `rows`, `host` and `total` as of `write`."""
    parts = [[r for r in rows if r["locked"] == locked] for locked in (False, True)]
    of_kind: Callable[[Sequence[Row], str], list[Row]] = lambda part, kind: [r for r in part if r["kind"] == kind]  # noqa: E731
    lines = [[TITLES[kind], *(_share(of_kind(part, kind), "right") for part in parts)] for kind in KINDS]
    lines += [["all", *(_share(part, "right") for part in parts)]]
    lines += [["not settled in time", *(_share(part, "unsettled") for part in parts)]]
    answered = [[r for r in part if score(r) != "unsettled"] for part in parts]
    lines += [["right, of settled answers", *(_share(part, "right") for part in answered)]]
    names = sorted({r["machine"] for r in rows})
    machines = [_machine(name, [r for r in rows if r["machine"] == name]) for name in names]
    times = [r["processor_seconds"] for r in rows]
    spent = f"median {np.median(times):.0f} s, longest {max(times):.0f} s" if times else "none"
    commits = ", ".join(sorted({f"`{r['commit'][:7]}`" for r in rows if r["commit"]}))
    ended_in_error = sum("error" in r and r["error"] != "time-out" for r in rows)
    shown = [r for r in parts[0] if score(r) != "right"]
    others = [[f"`{r['name']}`", *_expected(r), said(r)] for r in shown]
    head = ["", "development machines", "locked machines"]
    texts = [
        f"# Logs of machines by other equations\n\n{ABOUT}",
        f"{host} Revision {commits}; {len(rows)} of {total} logs, {ended_in_error} ended with an error. Processor time"
        f" of a diagnosis: {spent}.",
        table(head, lines),
        "## By machine\n\n" + table(["machine", "", *get_args(Score)], machines),
        "## Development logs with another answer\n\n" + table(["log", "hidden", "answer"], others),
    ]
    return "\n\n".join(texts)


def _expected(row: Row) -> list[str]:
    """Return what was hidden, in words."""
    return [" and ".join(" or ".join(names) for names in row["accepted"]) or row["kind"]]


def _share(rows: Sequence[Row], what: Score) -> str:
    """Return which share of some results has a score, with Wilson's interval."""
    if not rows:
        return "-"
    count = sum(score(r) == what for r in rows)
    low, high = wilson(count, len(rows))
    return f"{100 * count / len(rows):.0f} % [{100 * low:.0f}-{100 * high:.0f}] ({count} of {len(rows)})"


def _machine(name: str, rows: Sequence[Row]) -> list[str]:
    """Return a line of the table by machine."""
    counts = [str(sum(score(r) == one for r in rows)) for one in get_args(Score)]
    return [f"`{name}`", "locked" if rows[0]["locked"] else "", *counts]
