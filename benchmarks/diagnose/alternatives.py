"""A diagnosis against its alternatives, same data, same split: prediction error and blamed effects.

Three methods correct a model that lacks an effect:

- *diagnosis*: `concent diagnose` with its default settings, and the model with all accepted effects;
- *everything at once*: the parameters of all candidate effects of the library, fitted together with the initial states
  by bounded robust least squares, without a selection;
- *sysid toolbox*: MuJoCo's own `mujoco.sysid` (residual, `optimize`, `calculate_intervals`), which fits what a user
  names; here the plain numbers of the scene that are listed in `PLAIN`, from the measured initial states.

An effect is *blamed* where the 95 % interval of one of its parameters excludes its null value (for the diagnosis: where
it is accepted; a group counts as right if the hidden effect is in it). The data sets are of
`hidden_effects_data.py`, with other seeds; another recording of the same experiment, with another seed, is used for
scoring: windows of it are predicted, each from the measured state as corrected by the first 30 % of the window. The
measured data, their judges and diagnoses are those of `real.py`, which comes first.

    python -m benchmarks.diagnose.alternatives                      # what is not done yet, then the page
    python -m benchmarks.diagnose.alternatives --names pendulum-null-0
    python -m benchmarks.diagnose.alternatives --table              # the page alone

The toolbox needs packages that mujoco installs on request: pip install "mujoco[sysid]".
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from joblib import Parallel, delayed

from benchmarks.diagnose.alternatives_report import write_report
from benchmarks.diagnose.fit_everything import Blame, fit_everything
from benchmarks.diagnose.hidden_effects_data import DataSet, cases, make, true_model
from benchmarks.diagnose.real import FOLDERS, GAINS, Case, servo, tosses
from benchmarks.diagnose.real import Args as RealArgs
from benchmarks.diagnose.real_report import NAME as REAL
from benchmarks.diagnose.sysid_toolbox import fit_toolbox
from benchmarks.fit.held_out import noise_errors, spans_of
from benchmarks.pages import ROOT, machine, read_data, write_data
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.model import Model
from concent_warp.recording.recording import Recording

NAME = "diagnose_alternatives"
NAMES = (
    "pendulum-null-0",
    "drop-null-0",
    "slide-null-0",
    "pendulum-joint_friction-middle-0",
    "pendulum-load_friction-middle-0",
    "pendulum-actuator_lag-middle-0",
    "pendulum-actuator_gain-middle-0",
    "slide-sliding_friction-middle-0",
    "slide-gravity_tilt-middle-0",
    "spin-torsional_friction-middle-0",
    "drop-contact_compliance-middle-0",
    "tumble-inertia-middle-0",
)
"""Data sets: rigs that are simulated quickly, effects that all three ways know, and some that not all know."""
SHIFT, FRESH = 500, 900
"""Added to the seeds of the data that are fitted, and of those that judge."""
HEAD = 0.3


@dataclass(frozen=True)
class Args:
    """Command line."""

    names: tuple[str, ...] = NAMES
    """Data sets of `hidden_effects_data.py`."""
    data: Path = ROOT.parent / "shared" / "data"
    """Folder with the folders contactnets_cube and bam_xl330."""
    real: bool = True
    """Whether to try the measured data too."""
    jobs: int = 1
    """Data sets at a time."""
    again: bool = False
    """Do again what is done."""
    table: bool = False
    """Write the page from the figures that there are."""


Fitted = tuple[Model, list[Blame]]
"""A model, and what is blamed."""
WAYS: dict[str, Callable[[Model, Recording], Fitted]] = {}


def way(name: str) -> Callable[[Callable[[Model, Recording], Fitted]], Callable[[Model, Recording], Fitted]]:
    """Register a method to correct a model."""

    def enter(function: Callable[[Model, Recording], Fitted]) -> Callable[[Model, Recording], Fitted]:
        WAYS[name] = function
        return function

    return enter


@way("diagnosis")
def diagnosed(model: Model, recording: Recording) -> Fitted:
    """Diagnose, and take all that is accepted."""
    found = diagnose(model, recording, DiagnoseCfg(jobs=1, explain=False))
    groups = [*found.groups, *((f.name,) for f in found.accepted[len(found.groups) :])]
    blamed = [
        Blame(f.name.split("(")[0], tuple(n.split("(")[0] for n in group))
        for f, group in zip(found.accepted, groups, strict=True)
    ]
    return found.model, blamed


@way("everything at once")
def everything(model: Model, recording: Recording) -> Fitted:
    """Fit all candidate effects together."""
    return fit_everything(model, recording)


@way("sysid toolbox")
def toolbox(model: Model, recording: Recording) -> Fitted:
    """Fit MuJoCo's plain numbers by its toolbox."""
    return fit_toolbox(model, recording)


def main(args: Args) -> None:
    """Measure what is not done, and write data and page."""
    if not args.table:
        done = set() if args.again else set(read_data(NAME).get("rows", {}))
        known = {c.name: c for c in cases()}
        pending = [name for name in args.names if name not in done]
        work = Parallel(n_jobs=args.jobs, return_as="generator")(delayed(synthetic)(known[name]) for name in pending)
        for name, row in zip(pending, work, strict=True):
            assert row is not None
            keep(name, row)
        for name, case in real_cases(args).items() if args.real else ():
            if name not in done:
                keep(name, measured(case()))
    write_report(read_data(NAME))


def real_cases(args: Args) -> dict[str, Callable[[], Case]]:
    """Return how to get each of the measured cases, by the name of its row."""
    missing = [str(args.data / f) for f in FOLDERS.values() if not (args.data / f).is_dir()]
    if missing:
        print(f"no measured data in {' and '.join(missing)}: --data or --no-real", file=sys.stderr)
        raise SystemExit(2)
    settings = RealArgs(data=args.data)
    found: dict[str, Callable[[], Case]] = {f"servo, kp {kp:g}": partial(servo, settings, kp) for kp in GAINS}
    return {**found, "tosses": partial(tosses, settings)}


def keep(name: str, row: dict[str, Any]) -> None:
    """Keep the result of a data set."""
    rows = {**read_data(NAME).get("rows", {}), name: row}
    write_data(NAME, {"machine": machine(), "rows": rows})
    errors = ", ".join(f"{way} {r['error']:.2f} {r['blamed']} {r['seconds']:.0f} s" for way, r in row["ways"].items())
    print(f"{name}: nominal {row['nominal']:.2f}, floor {row['floor']}, {errors}", flush=True)


def synthetic(case: DataSet) -> dict[str, Any]:
    """Try all methods on a data set with a hidden effect."""
    data = make(replace(case, seed=case.seed + SHIFT))
    fresh = make(replace(case, seed=case.seed + FRESH))
    model = Model(data.scene)
    spans = spans_of(model, fresh.recording, HEAD)

    def error(m: Model) -> float:
        return pooled(noise_errors(m, spans))

    truth = true_model(data) if data.truth else model
    hidden = [t.effect for t in data.truth]
    floor = None if truth is None else error(truth)
    return {"unit": "noise", "hidden": hidden, "floor": floor, **tried(model, data.recording, error, hidden)}


def measured(case: Case) -> dict[str, Any]:
    """Try all methods on measured data, whose truth is unknown; the diagnosis is that of `real.py`."""
    judge = case.judges[0]

    def error(m: Model) -> float:
        return pooled(judge.errors(m))

    known = [s for part in read_data(REAL).values() for s in part["studies"] if s["title"] == case.title]
    if not known:
        print(f"{case.title}: run diagnose_real.py first", file=sys.stderr)
        raise SystemExit(2)
    accepted = [f["name"] for f in known[0]["diagnosis"]["effects"] if f["accepted"]]
    done = {
        "error": known[0]["steps"][-1]["from_first"][0]["after"],
        "seconds": known[0]["seconds"],
        "blamed": sorted(accepted),
    }
    rest = tried(case.model, case.seen, error, None, [name for name in WAYS if name != "diagnosis"])
    rest["ways"] = {"diagnosis": done, **rest["ways"]}
    return {"unit": judge.unit, "hidden": None, "floor": None, **rest}


def pooled(errors: np.ndarray) -> float:
    """Return the root mean square over windows or tosses."""
    return float(np.sqrt(np.nanmean(errors**2)))


def tried(
    model: Model,
    recording: Recording,
    error: Callable[[Model], float],
    hidden: Sequence[str] | None,
    chosen: Sequence[str] = (),
) -> dict[str, Any]:
    """Return for each method: error on held-out data, blamed effects, time."""
    ways = {}
    for name in chosen or WAYS:
        correct = WAYS[name]
        begin = time.perf_counter()
        corrected, blamed = correct(model, recording)
        spent = time.perf_counter() - begin
        row: dict[str, Any] = {"error": error(corrected), "seconds": spent, "blamed": sorted({b.name for b in blamed})}
        if hidden is not None:
            row["right"] = sorted({h for h in hidden for b in blamed if h in b.group})
            row["wrong"] = sorted({b.name for b in blamed if not set(b.group) & set(hidden)})
        ways[name] = row
    return {"nominal": error(model), "ways": ways}


if __name__ == "__main__":
    main(tyro.cli(Args))
