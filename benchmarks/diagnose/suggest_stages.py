"""The stages of a data set of `suggest.py`, each with its result in a file of its own as soon as it exists.

A folder for each data set: `begun.json` once it was begun, `first.json` with the first diagnosis, `methods.json` once
motions are looked for, `METHOD.json` with what a method suggests and, once the second diagnosis is done, what it came
to, and the motion in `METHOD.h5`. A stage reads what those before it wrote, so that they may run in different
processes, at different times or on different machines.
"""

from __future__ import annotations

import json
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.diagnose.suggest_report import METHODS, TIME_OUT
from benchmarks.diagnose.suggest_sets import SuggestSet, first_recording, open_group, outcome, second_recording
from benchmarks.pages import machine
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.diagnosis.suggestion.cfg import Method, SuggestCfg
from concent_warp.diagnosis.suggestion.suggest import suggest
from concent_warp.files import write_text
from concent_warp.model import Model
from concent_warp.recording.load import load_recording
from concent_warp.recording.merge import merged
from concent_warp.recording.recording import Demonstration, Recording
from concent_warp.simulate.parallel import limit_simulations

Task = tuple[str, ...]
"""Stage and method: ("first",), ("suggest",) or ("second", METHOD)."""


def next_tasks(folder: Path) -> list[Task]:
    """Return what can be done next for a data set: nothing where all is done."""
    first = _read(folder / "first.json")
    if first is None:
        return [("first",)]
    if first.get("group") is None:  # an error, too
        return []
    found = {method: _read(folder / f"{method}.json") for method in METHODS}
    tasks: list[Task] = [("second", method) for method, one in found.items() if one is not None and _is_open(one)]
    return [*tasks, ("suggest",)] if any(one is None for one in found.values()) else tasks


def _is_open(result: dict[str, Any]) -> bool:
    """Return whether the second diagnosis of a method is still to be done."""
    return "outcome" not in result and "like" not in result


def run_task(one: SuggestSet, task: Task, folder: Path, pieces: Path) -> None:
    """Run a stage; an error is its result.

    Args:
        one: The data set.
        task: The stage.
        folder: Folder of its results.
        pieces: Where pieces lie from which interrupted stages of all data sets go on.
    """
    own = pieces / one.name
    with limit_simulations(1):
        if task[0] == "first":
            _first(one, folder, own / "first")
        elif task[0] == "suggest":
            _suggestions(one, folder, own / "suggestion")
        else:
            _second(one, folder, task[1], own / task[1])


def begin(one: SuggestSet, folder: Path) -> None:
    """Note that a data set is begun."""
    if not (folder / "begun.json").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder / "begun.json", {"name": one.name, "machine": machine()})


def begin_suggestion(folder: Path) -> None:
    """Note that the methods of a data set are begun."""
    _write(folder / "methods.json", list(METHODS))


def _first(one: SuggestSet, folder: Path, pieces: Path) -> None:
    """Diagnose the first recording."""
    begun = time.perf_counter()
    try:
        recording, scene = first_recording(one)
        found, seconds = _diagnosed(Model(scene), recording, one.base.seed, pieces)
        asked = open_group(found.groups, list(one.base.magnitudes)) if found.verdict == "group" else None
        group, true = asked or (None, None)
        row = {"first": _told(found, seconds), "group": group, "true": true, "diagnosis": found.to_json()}
    except Exception:
        row = {"error": traceback.format_exc()}
    _write(folder / "first.json", {**row, "seconds": time.perf_counter() - begun})


def _suggestions(one: SuggestSet, folder: Path, pieces: Path) -> None:
    """Choose the motions of all methods that are not done; fits of hypotheses and ratings of motions are shared."""
    recording, scene = first_recording(one)
    diagnosis = (_read(folder / "first.json") or {})["diagnosis"]
    for method in METHODS:
        if (folder / f"{method}.json").is_file():
            continue
        begun = time.perf_counter()
        try:
            cfg = SuggestCfg(method=method, seed=one.base.seed)
            found = suggest(Model(scene), recording, cfg, diagnosis=diagnosis, state=pieces)
            result: dict[str, Any] = {**found.to_json(), "seconds": time.perf_counter() - begun}
            if found.recording is None:
                result["outcome"] = "none"
            else:
                found.save(folder / f"{method}.h5")
                result |= _like(folder, method)
        except Exception as error:
            result = _failed(error)
        _write(folder / f"{method}.json", result)


def _like(folder: Path, method: Method) -> dict[str, str]:
    """Return which method before suggests the same motion, whose second diagnosis is the same too."""
    for other in METHODS[: METHODS.index(method)]:
        path = folder / f"{other}.h5"
        if path.is_file() and _same(load_recording(path), load_recording(folder / f"{method}.h5")):
            return {"like": other}
    return {}


def _same(first: Recording, second: Recording) -> bool:
    """Return whether two motions are the same."""
    return len(first.demonstrations) == len(second.demonstrations) and all(
        a.payloads == b.payloads
        and _arrays(a).keys() == _arrays(b).keys()
        and all(np.array_equal(value, _arrays(b)[name]) for name, value in _arrays(a).items())
        for a, b in zip(first.demonstrations, second.demonstrations, strict=True)
    )


def _arrays(d: Demonstration) -> dict[str, np.ndarray]:
    """Return what makes a motion besides payloads: where it begins, its duration and its commands."""
    found = {"duration": np.array(d.duration)}
    found |= {name: value for name, value in (("qpos", d.qpos), ("qvel", d.qvel)) if value is not None}
    for name, channel in d.action.items():
        found |= {f"{name} time": channel.time, f"{name} value": channel.value}
    return found


def _second(one: SuggestSet, folder: Path, method: str, pieces: Path) -> None:
    """Perform what a method suggests, and diagnose both recordings."""
    path = folder / f"{method}.json"
    result, first = _read(path) or {}, _read(folder / "first.json") or {}
    try:
        recording, scene = first_recording(one)
        both = merged([recording, second_recording(one, load_recording(folder / f"{method}.h5"))])
        found, seconds = _diagnosed(Model(scene), both, one.base.seed, pieces)
        result["second"] = _told(found, seconds)
        result["outcome"] = outcome(found.groups, first["group"], first["true"])
    except Exception as error:
        result |= _failed(error)
    _write(path, result)


def _failed(error: Exception) -> dict[str, str]:
    """Return the result of a method that ended in an error."""
    return {"outcome": "error", "error": f"{type(error).__name__}: {error}"}


def _diagnosed(model: Model, recording: Recording, seed: int, folder: Path) -> tuple[Diagnosis, float]:
    """Return a diagnosis and the time that it took [s]."""
    begun = time.perf_counter()
    cfg = DiagnoseCfg(jobs=1, seed=seed, explain=False)
    return diagnose(model, recording, cfg, out=folder), time.perf_counter() - begun


def _told(found: Diagnosis, seconds: float) -> dict[str, Any]:
    """Return what counts of a diagnosis."""
    return {
        "verdict": found.verdict,
        "groups": [list(group) for group in found.groups],
        "ratio": [float(r) for r in found.ratio],
        "seconds": seconds,
    }


def row_of(one: SuggestSet, folder: Path) -> dict[str, Any] | None:
    """Return the row of a data set from its files; None where it was not begun.

    What was begun and has not ended is a "time-out". A group whose methods were not begun has none.
    """
    begun, first = _read(folder / "begun.json"), _read(folder / "first.json")
    if begun is None:
        return None
    row: dict[str, Any] = {
        "name": one.name,
        "rig": one.base.rig,
        "truth": sorted(one.base.magnitudes),
        "seed": one.base.seed,
        "repeat": one.repeat,
        "machine": begun["machine"],
        "seconds": 0.0,
    }
    if first is None:
        return {**row, "error": TIME_OUT}
    row |= {key: value for key, value in first.items() if key != "diagnosis"}
    if "error" in row or row["group"] is None:
        return {**row, "methods": {}}
    row["methods"] = _methods(folder) if (folder / "methods.json").is_file() else {}
    parts = [found for found in row["methods"].values() if "like" not in found]
    row["seconds"] += sum(f.get("seconds", 0.0) + f.get("second", {}).get("seconds", 0.0) for f in parts)
    return row


def _methods(folder: Path) -> dict[str, Any]:
    """Return what each method came to."""
    found = dict[str, Any]()
    for method in METHODS:
        result = _read(folder / f"{method}.json") or {}
        if "like" in result:
            same = found[result["like"]]
            result |= {key: same[key] for key in ("outcome", "second", "error") if key in same}
        found[method] = {"outcome": TIME_OUT, **result}
    return found


def rows_of(sets: Sequence[SuggestSet], out: Path) -> list[dict[str, Any]]:
    """Return the rows of all data sets that were begun."""
    return [row for one in sets if (row := row_of(one, out / one.name)) is not None]


def _read(path: Path) -> Any:
    """Return what a file holds; None where it is missing."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def _write(path: Path, value: Any) -> None:
    """Write a file as a whole or not at all."""
    write_text(path, json.dumps(value))
