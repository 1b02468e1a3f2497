"""What `concent compare` says of foreign logs: whether their models leave more than ordinary tolerances do.

python -m benchmarks.foreign.tolerances --jobs 2   # all logs that are not done, the page

Results are kept in `--out`, one file a log, so that the command may be stopped and called again.
"""

from __future__ import annotations

import json
import tempfile
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from joblib import Parallel, delayed

from benchmarks.foreign.cases import all_cases
from benchmarks.foreign.log import Case
from benchmarks.foreign.scoring import KINDS
from benchmarks.foreign.study import described
from benchmarks.independent.__main__ import revision
from benchmarks.independent.study import path
from benchmarks.pages import machine, machine_line, table, write_data, write_page
from concent_warp.comparison.compare import compare
from concent_warp.comparison.tolerances import ToleranceCfg
from concent_warp.files import write_text
from concent_warp.model import Model
from concent_warp.recording.load import load_recording

NAME = "tolerances"
ABOUT = """
`python -m benchmarks.foreign.tolerances --jobs 31` compares the model of each [foreign log](foreign.md) with the log,
as `concent compare` does, and counts what it says: that the model leaves more than [ordinary
tolerances](../compare.md) of its nominal values would alone, in at least one channel, or no more, or so little that it
is not asked. Where nothing is hidden, masses, lengths and gains of these logs are off by 0.3 to 2 %, friction and
damping by up to 4 %. No setting was chosen by looking at these logs. What a small effect leaves may be no more than
tolerances do: `concent diagnose` fits nominal values, and finds some of these.
"""
KEPT = ("name", "machine", "kind", "locked")
"""What rows say of their logs."""
HIDDEN = {
    "null": "nothing hidden",
    "single": "one effect",
    "pair": "two effects",
    "outside": "a cause that the library lacks",
}
OTHERWISE = "Something is hidden and the model leaves no more than tolerances, or nothing is and it leaves more."


@dataclass(frozen=True)
class Args:
    """Command line."""

    out: Path = Path("runs/tolerances")
    """Folder of the results."""
    jobs: int = 1
    """Logs at a time."""
    names: tuple[str, ...] = ()
    """Only logs of these names, and no page."""


def main(args: Args) -> None:
    """Compare what is not done yet, and write the page."""
    cases = [case for case in all_cases() if not args.names or case.name in args.names]
    if unknown := set(args.names) - {case.name for case in cases}:
        raise SystemExit(
            f"ordinary tolerances: no log is called {', '.join(sorted(unknown))}; "
            "python -m benchmarks.foreign --list prints all"
        )
    args.out.mkdir(parents=True, exist_ok=True)
    todo = [case for case in cases if not path(args.out, case.name).is_file()]
    begun = time.monotonic()
    work = Parallel(args.jobs, return_as="generator_unordered")(delayed(keep)(args.out, case) for case in todo)
    for count, name in enumerate(work, 1):
        left = (time.monotonic() - begun) / count * (len(todo) - count)
        print(f"{count} of {len(todo)}, about {left / 60:.0f} min left: {name}", flush=True)
    if args.names:
        return
    rows = [json.loads(path(args.out, case.name).read_text()) for case in cases]
    write({"machine": machine(), "revision": revision(), "rows": rows})


def write(data: dict[str, Any]) -> None:
    """Write the page and its data: the machine, and a row a log."""
    write_data(NAME, data)
    write_page(NAME, page(data["rows"], f"{machine_line(data['machine'])} Revision `{data['revision']}`."))


def keep(out: Path, case: Case) -> str:
    """Compare one log, keep the result, and return its name."""
    write_text(path(out, case.name), json.dumps(studied(case), allow_nan=False) + "\n")
    return case.name


def studied(case: Case) -> dict[str, Any]:
    """Return what a comparison says of a log."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / case.name
        case.make().write(folder)
        recording = load_recording(folder)
    result = {key: value for key, value in described(case).items() if key in KEPT}
    begun = time.process_time()
    try:
        found = compare(Model.from_recording(recording), recording)
    except Exception:
        return result | {"error": traceback.format_exc()}
    ratios = {channel: found.summarise(found.after, channel).ratio for channel in found.channels}
    known = {channel: ratio for channel, ratio in ratios.items() if ratio is not None and not np.isnan(ratio)}
    beyond = [c for c, of in found.tolerances.items() if known.get(c, 0.0) > of.high]
    return result | {
        "ratio": min(max(known.values(), default=0.0), 1e9),
        "asked": bool(found.tolerances),
        "beyond": beyond,
        "seconds": time.process_time() - begun,
    }


def said(row: dict[str, Any]) -> str:
    """Return what is said of a log."""
    if "error" in row:
        return "error"
    return "more" if row["beyond"] else "no more" if row["asked"] else "little"


def page(rows: Sequence[dict[str, Any]], host: str) -> str:
    """Return the page."""
    answers = ("more", "no more", "little", "error")
    titles = {"more": "more than tolerances", "no more": "no more", "little": "below 1.5 x noise", "error": "error"}
    lines = []
    for kind in KINDS:
        for locked in (False, True):
            part = [r for r in rows if r["kind"] == kind and r["locked"] == locked]
            counts = [str(sum(said(r) == answer for r in part)) for answer in answers]
            lines.append([f"{HIDDEN[kind]}, {'locked' if locked else 'development'} machines", str(len(part)), *counts])
    seconds = [r["seconds"] for r in rows if "seconds" in r]
    times = f"Processor time of a comparison: median {np.median(seconds):.0f} s, longest {max(seconds):.0f} s."
    head = ["", "logs", *(titles[answer] for answer in answers)]
    shown = [r for r in rows if not r["locked"] and (said(r) == "more") == (r["kind"] == "null")]
    others = [
        [f"`{r['name']}`", said(r), f"{r.get('ratio', np.nan):.1f} x", ", ".join(r.get("beyond", ()))] for r in shown
    ]
    draws = f"Settings: the default, {ToleranceCfg().draws} draws."
    return "\n\n".join(
        [
            f"# What ordinary tolerances leave\n{ABOUT}",
            f"{host} {times} {draws}",
            table(head, lines),
            f"## Development logs that say otherwise\n\n{OTHERWISE}",
            table(["log", "said", "worst channel", "channels with more"], others),
        ]
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
