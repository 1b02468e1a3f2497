"""The diagnosis of one foreign log, in a process of its own, with a limit of its time.

python -m benchmarks.foreign.study pendulum-null FOLDER  # writes FOLDER/pendulum-null.json
"""

from __future__ import annotations

import json
import tempfile
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from joblib.externals.loky import get_reusable_executor

from benchmarks.foreign.cases import all_cases, is_locked
from benchmarks.foreign.log import Case
from benchmarks.independent.study import LEFT_OUT, TOLD_SHARE, TimeOut, limited, path, processor_seconds
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.errors import ConcentError
from concent_warp.files import write_text
from concent_warp.model import Model
from concent_warp.recording.load import load_recording

SECONDS = 300.0
"""Duration of a diagnosis from which on it counts as wrong [s]."""
CORES = 2
"""Processes of a diagnosis."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    name: tyro.conf.Positional[str]
    """Log."""
    out: tyro.conf.Positional[Path]
    """Folder of the result."""
    commit: str = ""
    """Revision of the library, kept with the result."""
    limit: float = SECONDS
    """Limit of the diagnosis' duration [s]."""
    cores: int = CORES
    """Processes of the diagnosis."""


def main(args: Args) -> None:
    """Diagnose one log and keep the result."""
    found = [case for case in all_cases() if case.name == args.name]
    if not found:
        raise SystemExit(f"foreign logs: no log is called {args.name}; python -m benchmarks.foreign --list prints all")
    args.out.mkdir(parents=True, exist_ok=True)
    result = study(found[0], args.limit, args.cores) | {"commit": args.commit}
    write_text(path(args.out, args.name), json.dumps(result, allow_nan=False) + "\n")


def described(case: Case) -> dict[str, Any]:
    """Return what a result says of its log."""
    return {
        "name": case.name, "machine": case.machine, "cause": case.cause, "kind": case.kind,
        "accepted": [list(names) for names in case.accepted], "locked": is_locked(case.machine),
    }  # fmt: skip


def study(case: Case, limit: float = SECONDS, cores: int = CORES) -> dict[str, Any]:
    """Return the result of the diagnosis of a log as it lies in its folder, in plain types."""
    result = described(case)
    log = case.make()
    result["noise_stated"] = bool(log.noise)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / case.name
        log.write(folder)
        recording = load_recording(folder)
    begun, spent = time.perf_counter(), processor_seconds()
    try:
        with limited(limit):
            cfg = DiagnoseCfg(jobs=cores, explain=False, seconds=TOLD_SHARE * limit)
            found = diagnose(Model.from_recording(recording), recording, cfg).to_json()
            result |= {key: value for key, value in found.items() if key not in LEFT_OUT}
    except TimeOut:
        result["error"] = "time-out"
    except ConcentError as error:
        result["error"] = str(error)
    except Exception:
        result["error"] = traceback.format_exc()
    result["seconds"] = time.perf_counter() - begun
    get_reusable_executor().shutdown(kill_workers=True)
    result["processor_seconds"] = processor_seconds() - spent
    return result


if __name__ == "__main__":
    main(tyro.cli(Args))
