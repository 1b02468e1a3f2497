"""The page of all three measurements, from the data that each stores."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

from benchmarks.pages import machine_line, read_data, table, write_data, write_page

NAME = "robustness"


def store(part: str, data: dict[str, Any] | None) -> None:
    """Store the data of a part, if any, and write the page."""
    stored = read_data(NAME)
    if data is not None:
        stored[part] = data
        write_data(NAME, stored)
    write_page(NAME, page(stored))


def page(stored: dict[str, Any]) -> str:
    """Return the page with the parts that are stored."""
    text = "# Robustness\n\nWhat is promised, and what is not, is in [Security](../security.md).\n"
    for part, section in (("killed", killed), ("disk full", disk_full), ("at once", at_once)):
        if part in stored:
            text += "\n" + section(stored[part])
    return text


def about(module: str) -> str:
    """Return what the docstring of a benchmark says after its commands."""
    documented = importlib.import_module(f"benchmarks.robustness.{module}").__doc__ or ""
    return documented.split("\n\n", 2)[2].strip()


def killed(data: dict[str, Any]) -> str:
    """Return the section on runs that were killed."""
    rows, resumed, corrupt, same, count = [], 0, 0, 0, 0
    for command, trials in data["trials"].items():
        done = [t for t in trials if "error" not in t]
        counts = [sum(t["resumed"] for t in done), sum(len(t["corrupt"]) for t in done)]
        counts += [sum(t["resumed"] and not (_without_videos(t["differs"]) or t["left"]) for t in done)]
        begun = sum(t["files"] > 0 for t in done)
        moments = f"{min(t['after'] for t in done):.1f} to {max(t['after'] for t in done):.1f}"
        cells = [f"{data['seconds'][command]:.0f}", moments, f"{begun} of {len(done)}", f"{counts[0]} of {len(done)}"]
        rows.append([f"`{command}`", *cells, str(counts[1]), f"{counts[2]} of {len(done)}"])
        resumed, corrupt, same, count = (
            a + b for a, b in zip((resumed, corrupt, same, count), (*counts, len(done)), strict=True)
        )
    head = ["command", "whole run [s]", "killed after [s]", "after its first file", "resumed", "corrupt files"]
    head += ["same result"]
    return f"""## Killed and resumed

{about("killed")}

`python -m benchmarks.robustness.killed`. {machine_line(data["machine"])} Other work ran on the machine: durations are
no measure of speed.

**{resumed} of {count} runs were resumed, {corrupt} files were corrupt, {same} of {count} results are the same.**
*Same*: all files byte by byte, except times, paths, TensorBoard's log and encoded videos, which differ between two
uninterrupted runs as well; checkpoints of trainings to the last bit of weights, optimiser, worlds and random
generators; of `diagnose` the JSON that it prints.

{table(head, rows)}
[Killed while writing, and interrupted](resume.md): a fit.
"""


def disk_full(data: dict[str, Any]) -> str:
    """Return the section on full disks."""
    rows, fine, count = [], 0, 0
    for command, found in data["commands"].items():
        trials = found["trials"]
        sound = sum(not t["faults"] for t in trials)
        ended = [str(t["code"]) for t in trials]
        resumed = sum(t.get("resumed", False) for t in trials)
        able = sum("resumed" in t for t in trials)
        faults = sorted({fault for t in trials for fault in t["faults"]})
        rows.append(
            [command, ", ".join(ended), f"{sound} of {len(trials)}", f"{resumed} of {able}" if able else "",
             "; ".join(faults) or "none"]
        )  # fmt: skip
        fine, count = fine + sound, count + len(trials)
    free = [f"{t['share']:g}" for t in next(iter(data["commands"].values()))["trials"]]
    said = [t["said"] for found in data["commands"].values() for t in found["trials"] if t["code"]]
    head = ["command", "exit status", "sound", "resumed with room", "faults"]
    return f"""## Full disk

{about("disk_full")}

`python -m benchmarks.robustness.disk_full`. {machine_line(data["machine"])}

**{fine} of {count} runs are sound**: an exit status and no signal, one sentence with the path, the earlier files byte
for byte as before, nothing else left. Runs that have a state to go on from keep it beside the earlier run, say so, and
are then resumed on a disk with room. Shares of what is needed that are free: {_listed(free)}; with exit status 0 the
room was enough.

{table(head, rows)}
Sentences, such as: `{said[0]}`
"""


def at_once(data: dict[str, Any]) -> str:
    """Return the section on two commands at once."""
    rows, fine = [], 0
    for command, found in data["commands"].items():
        new, again = found["new"], found["overwrite"]
        faults = [*new["faults"], *again["faults"]]
        fine += not faults
        rows.append([command, str(new["succeeded"]), str(again["succeeded"]), "; ".join(faults) or "none"])
    said = [line for found in data["commands"].values() for line in found["new"]["said"]]
    head = ["command", "succeeded, nothing there", "succeeded, --overwrite", "faults"]
    return f"""## Two at once

{about("at_once")}

`python -m benchmarks.robustness.at_once`. {machine_line(data["machine"])}

**{fine} of {len(rows)} commands are sound**: one succeeds, the other ends with status 2 and one sentence with the path;
all files are of the one that succeeded, and none is unfinished.

{table(head, rows)}
Sentences, such as: `{said[0]}`
"""


def _without_videos(names: Sequence[str]) -> list[str]:
    """Return the names of files that are no videos."""
    return [name for name in names if not name.endswith(".mp4")]


def _listed(words: Sequence[str]) -> str:
    """Return words as a list in a sentence."""
    return f"{', '.join(words[:-1])} and {words[-1]}"
