"""The diagnosis of one data set, in a process of its own, with a limit of its time.

python -m benchmarks.independent.study pendulum-null-0 FOLDER  # writes FOLDER/pendulum-null-0.json
"""

from __future__ import annotations

import json
import resource
import signal
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import tyro
from joblib.externals.loky import get_reusable_executor

from benchmarks.independent.data_set import Data, DataSet
from benchmarks.independent.kept_data import is_kept, load
from benchmarks.independent.split import locked_names
from benchmarks.independent.worlds import all_sets, make
from concent_warp.comparison.compare import CompareCfg, compare
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.errors import ConcentError
from concent_warp.files import write_text
from concent_warp.model import Model

CORES = 2
"""Processes of a diagnosis."""
SECONDS = 300.0
"""Duration of a diagnosis from which on it counts as wrong [s]: 5 minutes on two cores."""
TOLD_SHARE = 0.95
"""Share of that time that the diagnosis is told that it has, see `DiagnoseCfg.seconds`; what is unsettled then is
wrong, too."""
LEFT_OUT = ("where", "detectable", "next_experiment", "versions")
"""Entries of a diagnosis that no score needs."""


class TimeOut(BaseException):
    """The diagnosis took too long; not an `Exception`, so that nothing on the way catches it."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    name: tyro.conf.Positional[str]
    """Data set."""
    out: tyro.conf.Positional[Path]
    """Folder of the result."""
    commit: str = ""
    """Revision of the library, kept with the result."""
    limit: float = SECONDS
    """Limit of the diagnosis' duration [s]."""
    cores: int = CORES
    """Processes of the diagnosis."""
    recordings: Path | None = None
    """Folder of data sets that were made elsewhere; what it lacks is made here."""


def main(args: Args) -> None:
    """Diagnose one data set and keep the result."""
    (case,) = [c for c in all_sets() if c.name == args.name]
    args.out.mkdir(parents=True, exist_ok=True)
    result = study(case, args.limit, args.cores, args.recordings) | {"commit": args.commit}
    write_text(path(args.out, case.name), json.dumps(result, allow_nan=False) + "\n")


def path(out: Path, name: str) -> Path:
    """Return where the result of a data set lies."""
    return out / f"{name}.json"


def described(case: DataSet) -> dict[str, Any]:
    """Return what a result says of its data set before that is made."""
    return {
        "name": case.name, "world": case.world, "kind": case.kind, "rig": case.rig, "size": case.size,
        "seed": case.seed, "demonstrations": case.demonstrations, "noise_stated": case.noise_stated,
        "locked": case.name in locked_names(), "hidden": sorted(case.magnitudes),
    }  # fmt: skip


def study(case: DataSet, limit: float = SECONDS, cores: int = CORES, recordings: Path | None = None) -> dict[str, Any]:
    """Return the result of the diagnosis of a data set, in plain types."""
    result = described(case)
    data = load(case, recordings) if recordings is not None and is_kept(case, recordings) else make(case)
    result["truth"] = [
        {"name": t.effect, "parameters": dict(t.parameters), "target": list(t.target), "known": t.known}
        for t in data.truth
    ]
    begun, spent = time.perf_counter(), processor_seconds()
    found: Diagnosis | None = None
    try:
        with limited(limit):
            cfg = DiagnoseCfg(jobs=cores, seed=case.seed, explain=False, seconds=TOLD_SHARE * limit)
            found = diagnose(Model(data.scene), data.recording, cfg)
    except TimeOut:
        result["error"] = "time-out"
    except ConcentError as error:
        result["error"] = str(error)
    except Exception:
        result["error"] = traceback.format_exc()
    result["seconds"] = time.perf_counter() - begun
    get_reusable_executor().shutdown(kill_workers=True)
    result["processor_seconds"] = processor_seconds() - spent
    result["megabytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if found is not None:
        result |= _slim(found)
        result["held_out"] = held_out_errors(found, data)
    return result


def processor_seconds() -> float:
    """Return the processor time of this process and of those that it has ended [s]."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raise `TimeOut` in the block when it has taken so long [s]."""

    def end(number: int, frame: FrameType | None) -> None:
        del number, frame
        raise TimeOut

    before = signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _slim(found: Diagnosis) -> dict[str, Any]:
    """Return a diagnosis in plain types, without what no score needs."""
    return {key: value for key, value in found.to_json().items() if key not in LEFT_OUT}


def held_out_errors(found: Diagnosis, data: Data) -> dict[str, Any]:
    """Return errors on the held-out recording of the model as given and of the saved one, over the noise.

    An error is the root mean square over the channels of each channel's root mean square residual over its noise.
    """
    if found.model is found.models[0] or not found.model.effects:
        return {"changed": False}
    models = {"before": found.models[0], "after": found.model}
    try:
        comparison = compare(models, data.held_out, CompareCfg(phases="none"))
    except ConcentError as error:
        return {"changed": True, "error": str(error)}
    errors: dict[str, Any] = {"changed": True}
    for model in models:
        ratios = [comparison.summarise(model, channel).ratio for channel in comparison.channels]
        errors[model] = float(np.sqrt(np.mean([r**2 for r in ratios if r is not None])))
    return errors


if __name__ == "__main__":
    main(tyro.cli(Args))
