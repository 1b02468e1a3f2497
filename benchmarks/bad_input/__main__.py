"""Error messages for bad input: runs every case and writes the page with the table of outcomes.

python -m benchmarks.bad_input [--output FILE] [--area AREA] [--sample SHARE] [--jobs N] [--examples N]
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy and torch are imported: a fork keeps no threads

import argparse
import sys
from pathlib import Path

from benchmarks.bad_input.all_cases import cases
from benchmarks.bad_input.attempt import Outcome, outcomes
from benchmarks.bad_input.page import page
from benchmarks.bad_input.random_input import random_outcomes

OUTPUT = Path(__file__).parents[2] / "docs" / "benchmarks" / "bad_input.md"


def main() -> int:
    """Run the cases, write the page; the exit status says whether all went as required."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    parser.add_argument("--area", default="", help="only areas that contain this text; no random input")
    parser.add_argument("--name", default="", help="only cases whose name or line contains this text")
    parser.add_argument("--sample", type=int, default=1, help="only one case of so many in each area")
    parser.add_argument("--jobs", type=int, default=2, help="commands at a time")
    parser.add_argument("--examples", type=int, default=300, help="random inputs of each kind; 0: none")
    arguments = parser.parse_args()
    chosen = [c for c in cases() if arguments.area in c.area and arguments.name in f"{c.name} {c.line}"]
    chosen = chosen[:: arguments.sample]
    found = []
    for outcome in outcomes(chosen, arguments.jobs):
        found.append(outcome)
        if outcome.faults:
            print(f"FAULT {fault_text(outcome)}", file=sys.stderr, flush=True)
    order = {case: k for k, case in enumerate(chosen)}
    found.sort(key=lambda outcome: order[outcome.case])
    tried = random_outcomes(arguments.examples) if arguments.examples and not arguments.area else {}
    arguments.output.write_text(page(found, tried))
    faults = sum(bool(outcome.faults) for outcome in found) + sum(bool(one.faults) for one in tried.values())
    print(f"{len(found)} cases, {faults} with faults; wrote {arguments.output}")
    return int(faults > 0)


def fault_text(outcome: Outcome) -> str:
    """Return a fault with the command and the first lines that it printed."""
    case = outcome.case
    return f"{case.area}: {case.name}: concent {case.line[:200]}: {outcome.faults}\n{outcome.message[:1500]}"


if __name__ == "__main__":
    sys.exit(main())
