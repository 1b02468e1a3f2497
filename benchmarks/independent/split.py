"""The locked part of the data sets, which is diagnosed once, at the end.

python -m benchmarks.independent.split  # writes split.json by the rule

The rule sees names only: a number between 0 and 1 from the SHA-256 of a text. Locked are, in the world on MuJoCo, the
`LOCKED_RIGS` rigs whose names have the smallest numbers, and of the others every key (rig and effects) whose number is
below `LOCKED_SHARE`; in the worlds on Drake and on Bullet every key whose number is below `LOCKED_HALF`. Whether a set
is locked does not depend on which others there are.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from benchmarks.independent.data_set import DataSet, number
from benchmarks.independent.worlds import all_sets
from concent_warp.files import write_text
from concent_warp.reality.rigs.registry import RIGS

PATH = Path(__file__).with_name("split.json")
LOCKED_RIGS = 2
LOCKED_SHARE = 0.25
LOCKED_HALF = 0.5


def locked_rigs() -> list[str]:
    """Return the rigs of the world on MuJoCo that are locked as a whole."""
    return sorted(sorted(RIGS, key=number)[:LOCKED_RIGS])


def locked_by_rule(case: DataSet) -> bool:
    """Return whether the rule locks a data set."""
    if case.world != "mujoco":
        return number(case.key) < LOCKED_HALF
    return case.rig in locked_rigs() or number(case.key) < LOCKED_SHARE


def by_rule(cases: Sequence[DataSet]) -> dict[str, list[str]]:
    """Return the split of some data sets: locked rigs, names of locked and of development sets."""
    return {
        "locked_rigs": locked_rigs(),
        "locked": [c.name for c in cases if locked_by_rule(c)],
        "development": [c.name for c in cases if not locked_by_rule(c)],
    }


def locked_names() -> set[str]:
    """Return the names of the locked data sets, from the file."""
    return set(json.loads(PATH.read_text())["locked"])


def main() -> None:
    """Write the split."""
    split = by_rule(all_sets())
    write_text(PATH, json.dumps(split, indent=1) + "\n")
    print(f"{len(split['locked'])} locked, {len(split['development'])} for development")


if __name__ == "__main__":
    main()
