"""The page of `suggest.py`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.diagnose.suggest_sets import PART, SEEDS, summary
from benchmarks.pages import FOLDER, machine_line, table, write_page
from concent_warp.diagnosis.suggestion.cfg import Method
from concent_warp.files import write_text

NAME = "suggest"
METHODS: tuple[Method, ...] = ("best", "menu", "random")
TITLES = {
    "best": "suggested (best of menu and search)",
    "menu": "best of the fixed menu",
    "random": "random trajectory",
}
TIME_OUT = "time-out"
"""Outcome of what was begun and had not ended when the time was up."""
LOOKED_AT = 3
"""Seeds of each data set whose former results were looked at when settings were chosen: the first ones."""
DATA = FOLDER / "data" / f"{NAME}.jsonl"
WITHOUT_WEIGHTS = FOLDER / "data" / f"{NAME}_without_weights.jsonl"
"""Rows of a variant that is not kept, on seeds that nothing was chosen by."""


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a file, the last one of each name; lines that were cut off are left out."""
    found: dict[str, dict[str, Any]] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else ():
        try:
            row = json.loads(line)
        except ValueError:
            continue
        found[row["name"]] = row
    return list(found.values())


def write_report(rows: Sequence[Mapping[str, Any]], count: int) -> None:
    """Write the page and its data.

    Args:
        rows: Rows that were measured; those of the data of the page where there are none.
        count: Number of data sets.
    """
    kept = list(rows) or read_rows(DATA)
    if not kept:
        raise SystemExit("nothing was measured yet")
    write_text(DATA, "".join(json.dumps(row) + "\n" for row in kept))
    write_page(NAME, page(kept, count))


def page(rows: Sequence[Mapping[str, Any]], count: int) -> str:
    """Return the page."""
    whole = [row for row in rows if "error" not in row]
    groups = [row for row in whole if row["group"] is not None]
    asked = [row for row in groups if row["methods"]]
    hosts = " ".join(dict.fromkeys(machine_line(row["machine"]) for row in rows))
    separable = [row for row in asked if row["methods"]["best"]["outcome"] != "none"]
    late = sum(row.get("error") == TIME_OUT for row in rows)
    share, failed = f"{100 * PART:.0f} %", len(rows) - len(whole) - late
    hours = sum(row["seconds"] for row in rows) / 3600
    unanswered = sum(any(m["outcome"] == TIME_OUT for m in row["methods"].values()) for row in asked)
    text = f"""# Suggested recordings

Written by `benchmarks/diagnose/suggest.py`; do not edit. {hosts}

`python -m benchmarks.diagnose.suggest`: how often the recording that `concent suggest` asks for resolves a group,
effects that a diagnosis cannot distinguish. The data are those of the [hidden effects](hidden_effects.md) with one or
two effects of the library and one demonstration, each on {SEEDS} seeds, none of them used there. The first recording
is the first {share} of each, of its time or of its throws, since short recordings leave more open.

Of {count} data sets {len(rows)} were begun, in random order, those of the first seed first; {late} of these were
stopped in the first diagnosis when the time was up, and {failed} ended in an error. {len(groups)} ended in a group that
the hidden effect is in; for {len(asked)} of these motions were looked for, in the same order. Each of them counts:
{unanswered} that had not ended when the time was up are failures ("time-out"). {hours:.1f} hours of one core in all.
The last stages of four sets, `arm-joint_offset-middle-0-part-3`, `slide-anisotropic_friction-large-0-part-3` and
`spin-torsional_friction` with seeds 0 and 3, ran on AMD EPYC, 2 cores.

Each motion is performed in Reality with the same hidden effect, and both recordings are diagnosed together. All methods
have the same longest duration and the same limits; none knows the truth. The first two may ask for known weights on
links and objects, where no motion without them decides everything; a random trajectory has none.

"""
    head = ["motion", "data sets", "right", "wrong", "still open", "nothing suggested", "time-out", "error"]
    text += table(head, [_shares(asked, method) for method in METHODS])
    text += """
*Right*: the hidden effect is named alone. *Wrong*: others are named without it. *Still open*: it is named with others.
*Nothing suggested*: all motions within the limits are expected to leave the hypotheses as close as they are, as the
offset of all joints and that of the frame in which a camera sees an arm. A random trajectory is performed whatever it
is expected to bring.
"""
    halves = {
        f"the first {LOOKED_AT}": [row for row in asked if row["repeat"] < LOOKED_AT],
        "others": [row for row in asked if row["repeat"] >= LOOKED_AT],
    }
    text += f"""
By seeds: former results of the first {LOOKED_AT} were looked at when it was chosen that a difference of less than
`clear_separation` counts less, and three of their data sets when weights were added. Nothing was chosen by the others.

"""
    split = [[title, *_shares(of, method)] for title, of in halves.items() for method in METHODS if of]
    text += table(["seeds", *head], split)
    if separable:
        text += f"\nWhere something was suggested by the first method ({len(separable)} data sets):\n\n"
        text += table(head, [_shares(separable, method) for method in METHODS])
    text += "\n## Data sets\n\nGroup of the first diagnosis, the hidden effect in bold; what each method came to.\n\n"
    text += table(["data set", "group", *METHODS, "motion", "duration [s]"], [_row(row) for row in groups])
    text += "\n## Time\n\nSeconds on one core, median.\n\n"
    text += table(["rig", "groups", "first diagnosis", "suggestion", "second diagnosis"], _times(asked))
    text += _variant(read_rows(WITHOUT_WEIGHTS), head)
    text += """
## What this does not show

Measured data; a table that is turned; a second suggestion after the first; and how much the evidence depends on errors
of formulas, which are small in Reality. Without weights the former method resolved 48 of 93 groups (52 %) rightly and 6
wrongly, its menu 24 and 8, a random trajectory 39 and 3 of the 64 that did not end in an error of the benchmark
(2026-11-27, the same seeds, all of them). The three data sets that were looked at are
`pendulum-actuator_gain-middle-0-part-1`, `spin-torsional_friction-middle-0-part` and
`slide-sliding_friction-large-0-part`.
"""
    return text


def _variant(rows: Sequence[Mapping[str, Any]], head: Sequence[str]) -> str:
    """Return the section on the menu first, and weights last."""
    if not rows:
        return ""
    hosts = " ".join(dict.fromkeys(machine_line(row["machine"]) for row in rows))
    return f"""
## The menu first

Since these figures a motion of the menu is taken without a search where it is expected to bring twice the evidence that
is needed (`SuggestCfg.sufficient`): above, the menu was right in all seven data sets where only one of them was, in six
of them because the second diagnosis of long throws did not end. Not all was measured again. First it was tried, at
revision `07795a5c`, with weights asked for only where no motion of the menu without them is so, on the {len(rows)}
groups of seeds 3 to 5, which nothing was chosen by (`python -m benchmarks.diagnose.suggest --names` with those of the
table). {hosts}

{table(head, [_shares(rows, method) for method in METHODS])}
All three wrong answers of the first method, and two of its open ones, come from a ball that rolls without weights,
where one that spins with weights tells friction against spinning from inertia. Weights are therefore asked for as
before, where the difference is less than `SuggestCfg.clear_separation`, and the menu with weights comes before a
search. With that, at revision `32974873`, of the six data sets of `spin` four come to the right answer, one stays open
and one was stopped, of the nine of `slide` eight and one (AMD EPYC, 2 cores). Their former results had been looked at
then; the others were not measured again.

{table(["data set", "group", *METHODS, "motion", "duration [s]"], [_row(row) for row in rows])}"""


def _shares(rows: Sequence[Mapping[str, Any]], method: str) -> list[str]:
    """Return the row of a method."""
    found, count = summary(rows, method), max(len(rows), 1)
    cells = [f"{found[key]} ({100 * found[key] / count:.0f} %)" for key in ("right", "wrong", "open", "none")]
    return [TITLES[method], str(len(rows)), *cells, str(found[TIME_OUT]), str(found["error"])]


def _row(row: Mapping[str, Any]) -> list[str]:
    """Return the row of a data set."""
    group = ", ".join(f"**{name}**" if name == row["true"] else name for name in row["group"])
    best = row["methods"].get("best", {})
    name = best.get("name") or "-"
    duration = f"{best['duration']:.1f}" if best.get("duration") else "-"
    outcomes = [row["methods"].get(m, {"outcome": "not begun"})["outcome"] for m in METHODS]
    return [f"`{row['name']}`", group, *outcomes, name, duration]


def _times(rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return the times by rig."""
    found = []
    for rig in dict.fromkeys(row["rig"] for row in rows):
        own = [row for row in rows if row["rig"] == rig]
        best = [row["methods"]["best"] for row in own]
        columns = [
            [row["first"]["seconds"] for row in own],
            [b["seconds"] for b in best if "seconds" in b],
            [b["second"]["seconds"] for b in best if "second" in b],
        ]
        found.append([rig, str(len(own)), *(f"{np.median(c):.0f}" if c else "-" for c in columns)])
    return found
