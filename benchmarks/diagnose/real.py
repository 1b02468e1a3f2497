"""Which effects does a diagnosis find in measured data, and do they hold on data that it has not seen?

Two sets of measurements, neither of which anything here was tuned to:

- Tosses of a cube on a board (ContactNets; Pfrommer, Halm, Posa, CoRL 2020). The model is the published one: a box with
  the published edge, mass, inertia and friction, on a plane. Some tosses, drawn at random, are diagnosed; others judge.
- Logs of an XL330 servo that swings a payload (BAM; Duclusaud, Passault, Padois, Daney, 2024), at two gains of its
  controller. The model has the motor's constants as they are roughly known, no friction, and a drive strength that is
  fitted from the start. Logs at one gain are diagnosed; those at the other judge, in a model with that gain.

    python -m benchmarks.diagnose.real --data ../shared/data       # both
    python -m benchmarks.diagnose.real --parts servo               # one of them; the page keeps the other's figures
    python -m benchmarks.diagnose.real --table                     # the page again, from the figures

What is stopped goes on from its finished pieces, in runs/diagnose_real, in a folder named after the code: pieces of
other code are not used again. The page is written after each diagnosis.

What judges shares nothing with the diagnosis but the simulator: windows of the recordings that were held out, and
these as a whole, see `held_out.py`. After each addition the model predicts them, and so does the model that
`concent diagnose --apply` saves, which is the last; so it does with each decoy added to it, fitted to the same data as
the diagnosis had.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from benchmarks.diagnose.real_report import NAME, write_report
from benchmarks.fit.held_out import Spans, by_demonstration, change, cut_spans, prediction_errors
from benchmarks.pages import ROOT, machine, read_data, write_data
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.effects.effect import Effect
from concent_warp.effects.registry import effect_class
from concent_warp.files import write_text
from concent_warp.fit.effects.least_squares import LeastSquaresCfg, Solver
from concent_warp.fit.effects.observation import Window
from concent_warp.fit.effects.observe import observe
from concent_warp.fit.effects.prediction import Prediction
from concent_warp.model import Model
from concent_warp.recording.formats.bam import DRIVE, JOINT, SENSOR, read_bam
from concent_warp.recording.formats.contactnets import read_contactnets
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene

Part = Literal["tosses", "servo"]
FOLDERS: dict[Part, str] = {"tosses": "contactnets_cube", "servo": "bam_xl330"}
GAINS = (100.0, 400.0)
POSITION, ORIENTATION = "cube_position", "cube_orientation"
TOSS_STEP = 0.0017
"""Time step of the tosses [s], a quarter of the camera's."""
TOSS_SPAN = (0.3, 0.1)
"""Windows of tosses, and their heads [s]."""
SERVO_SPAN = (0.4, 0.1)
"""Windows of swings: 0.3 s are predicted."""
MOVING = 0.02
"""A window in which nothing moves by more than this [m or rad] is rest."""
DEGREES = 180 / np.pi
DECOYS: dict[Part, tuple[str, ...]] = {
    "tosses": ("air_drag", "torsional_friction", "rolling_friction"),
    "servo": ("stribeck_friction", "actuator_delay"),
}
LADDERS: dict[Part, tuple[str, tuple[tuple[str, ...], ...], tuple[tuple[str, ...], ...]]] = {
    "tosses": ("as given", (("sliding_friction",), ("contact_compliance",), ("time_base", "length_scale")), ()),
    "servo": (
        "drive strength alone",
        (("joint_friction", "joint_damping"), ("load_friction",)),
        (("stribeck_friction",), ("actuator_delay",)),
    ),
}
"""The model at the start, effects in the order of the literature, each fitted on top of those before it, and effects
that are added alone on top of all these."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    data: Path = ROOT.parent / "shared" / "data"
    """Folder with the folders contactnets_cube and bam_xl330."""
    parts: tuple[Part, ...] = ("tosses", "servo")
    fitted: int = 12
    """Tosses that are diagnosed."""
    judged: int = 60
    """Tosses that judge."""
    seed: int = 0
    """Of the split of the tosses."""
    jobs: int = len(os.sched_getaffinity(0))
    """Processes of a diagnosis."""
    pieces: Path = ROOT / "runs" / "diagnose_real"
    """Where finished pieces are kept."""
    table: bool = False
    """Write the page from the figures that there are."""


@dataclass(frozen=True)
class Judge:
    """Data that were held out, and what a model makes of them."""

    name: str
    unit: str
    per_unit: float
    """Figures in this unit for one SI unit."""
    channel: str
    spans: Spans
    to: Callable[[Model], Model]
    """Turns a model of the diagnosed data into one of these data."""
    grouped: bool
    """Whether demonstrations are the units of tests; else windows."""
    held_out: bool = True
    """Whether these data were not diagnosed."""

    def errors(self, model: Model) -> np.ndarray:
        """Return the error of each unit."""
        found = prediction_errors(self.to(model), self.spans, [self.channel])[self.channel] * self.per_unit
        return by_demonstration(found, self.spans.group) if self.grouped else found


@dataclass(frozen=True)
class Case:
    """A model, what it is diagnosed on, and what judges."""

    title: str
    part: Part
    model: Model
    seen: Recording
    judges: list[Judge]


class Stopwatch:
    """Wall and processor time of a diagnosis, over all runs that it took."""

    def __init__(self, path: Path) -> None:
        """Go on from the times in a file."""
        self.path = path
        self.before = json.loads(path.read_text()) if path.is_file() else [0.0, 0.0]
        self.begun = time.perf_counter(), processor_seconds()

    def read(self) -> tuple[float, float]:
        """Return wall and processor time so far [s]."""
        wall, processor = time.perf_counter() - self.begun[0], processor_seconds() - self.begun[1]
        return self.before[0] + wall, self.before[1] + processor

    def save(self) -> None:
        """Keep the times for a run that goes on from here."""
        write_text(self.path, json.dumps(self.read()))


def main(args: Args) -> None:
    """Measure, and write data and page."""
    if not args.table:
        missing = [str(args.data / FOLDERS[part]) for part in args.parts if not (args.data / FOLDERS[part]).is_dir()]
        if missing:
            print(f"no measured data in {' and '.join(missing)}; say where they are with --data", file=sys.stderr)
            raise SystemExit(2)
        args = replace(args, pieces=args.pieces / code_digest())
        args.pieces.mkdir(parents=True, exist_ok=True)
        for part in args.parts:
            cases = [tosses(args)] if part == "tosses" else [servo(args, kp) for kp in GAINS]
            studies: list[dict[str, Any]] = []
            for case in cases:
                studies.append(study(case, args))
                write_data(NAME, {**figures(), part: {"studies": studies, "machine": machine()}})
                write_report(figures())
    write_report(figures())


def figures() -> dict[str, Any]:
    """Return the figures of the page, without those of a part that an earlier layout has."""
    return {part: old for part, old in read_data(NAME).items() if all("sentences" in s for s in old["studies"])}


def code_digest() -> str:
    """Return a hash of all code that a study depends on."""
    digest = sha256()
    for path in (*sorted((ROOT / "concent_warp").rglob("*.py")), Path(__file__), ROOT / "benchmarks/fit/held_out.py"):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def tosses(args: Args) -> Case:
    """Return some tosses to diagnose and others that judge."""
    recording = read_contactnets(args.data / FOLDERS["tosses"])
    order = np.random.default_rng(args.seed).permutation(len(recording.demonstrations))
    names = [recording.demonstrations[i].name for i in order]
    seen = recording.only(names[: args.fitted])
    unseen = recording.only(names[args.fitted : args.fitted + args.judged])
    spec = Scene(recording.scene, recording.source).spec()
    spec.option.timestep = TOSS_STEP
    model = Model(Scene.from_spec(spec, "cube"))
    windows = cut_spans(model, unseen, *TOSS_SPAN, moving=MOVING)
    whole = cut_spans(model, unseen, None, TOSS_SPAN[1])
    judges = [
        Judge(f"{name}, {which}", unit, per_unit, channel, spans, same, True)
        for which, spans in (("windows", windows), ("whole toss", whole))
        for name, unit, per_unit, channel in (
            ("position", "mm", 1e3, POSITION),
            ("orientation", "deg", DEGREES, ORIENTATION),
        )
    ]
    title = f"{len(seen.demonstrations)} tosses diagnosed, {len(unseen.demonstrations)} others judge"
    return Case(title, "tosses", model, seen, judges)


def servo(args: Args, kp: float) -> Case:
    """Return the logs at one gain to diagnose, those at the other to judge."""
    other = GAINS[1 - GAINS.index(kp)]
    seen, unseen = (read_bam(args.data / FOLDERS["servo"], kp=gain) for gain in (kp, other))
    model = Model(Scene(seen.scene, seen.source)).add(effect_class("actuator_gain")(DRIVE))
    there = Scene(unseen.scene, unseen.source)

    def moved(m: Model) -> Model:
        timestep = m.scene.model.opt.timestep
        return replace(m, scene=there if timestep == there.model.opt.timestep else there.with_timestep(timestep))

    windows = cut_spans(moved(model), unseen, *SERVO_SPAN, moving=MOVING)
    whole = cut_spans(moved(model), unseen, None, SERVO_SPAN[1])
    own = cut_spans(model, seen, *SERVO_SPAN, moving=MOVING)
    judges = [
        Judge(f"kp {other:g}, windows", "deg", DEGREES, SENSOR, windows, moved, False),
        Judge(f"kp {other:g}, whole log", "deg", DEGREES, SENSOR, whole, moved, True),
        Judge(f"kp {kp:g}, diagnosed, windows", "deg", DEGREES, SENSOR, own, same, False, held_out=False),
    ]
    return Case(f"kp {kp:g} diagnosed, kp {other:g} judges", "servo", model, seen, judges)


def same(model: Model) -> Model:
    """Return the model itself."""
    return model


def study(case: Case, args: Args) -> dict[str, Any]:
    """Diagnose a recording and judge every model, and what the literature and decoys make of the same data."""
    name = sha256(json.dumps([case.title, [d.name for d in case.seen.demonstrations]]).encode()).hexdigest()[:12]
    path, watch = args.pieces / f"{name}.json", Stopwatch(args.pieces / f"{name}.seconds.json")
    if path.is_file():
        return json.loads(path.read_text())

    def progress(share: float, text: str) -> None:
        watch.save()
        print(f"{case.title}: {100 * share:3.0f} % {text:40s} {watch.read()[0]:5.0f} s", flush=True)

    diagnosis = diagnose(case.model, case.seen, DiagnoseCfg(jobs=args.jobs), out=args.pieces, progress=progress)
    end_workers()
    watch.save()
    wall, processor = watch.read()
    print(f"{case.title}: {diagnosis.verdict}, {wall:.0f} s, {processor:.0f} s of processors", flush=True)
    print("\n".join(f"  {sentence}" for sentence in diagnosis.sentences()), flush=True)
    windows = observe(case.model, case.seen)
    found: dict[str, Any] = {
        "title": case.title,
        "part": case.part,
        "recordings": len(case.seen.demonstrations),
        "jobs": args.jobs,
        "seconds": wall,
        "processor_seconds": processor,
        "judges": [
            {"name": j.name, "unit": j.unit, "units": len(j.errors(case.model)), "held_out": j.held_out}
            for j in case.judges
        ],
        "diagnosis": diagnosis.to_json(),
        "sentences": diagnosis.sentences(),
        "steps": judged(step_names(case.model, diagnosis.models), diagnosis.models, case.judges),
        "decoys": decoys(diagnosis.model, windows, case),
        "ladder": ladder(case.model, windows, case),
    }
    write_text(path, json.dumps(found))
    return found


def step_names(given: Model, models: Sequence[Model]) -> list[str]:
    """Return the names of the models of a diagnosis: what each has that the one given has not; the last is saved."""
    names = ["as given"]
    for model in models[1:]:
        added = [a.effect for a in model.effects[len(given.effects) :]]
        parts = ["nominal values"] if any(e.nominal for e in added) else []
        if model.scene.model.opt.timestep != given.scene.model.opt.timestep:
            parts.append("shorter time step")
        names.append(f"with {', '.join([*(e.name for e in added if not e.nominal), *parts]) or 'nothing'}")
    return [*names[:-1], f"{names[-1]} (saved)"]


def judged(names: Sequence[str], models: Sequence[Model], judges: Sequence[Judge]) -> list[dict[str, Any]]:
    """Return for each model its errors, against the first one's and against the one's before it."""
    errors = [[j.errors(m) for j in judges] for m in models]
    rows = []
    for k, name in enumerate(names):
        first = [asdict(change(a, b)) for a, b in zip(errors[0], errors[k], strict=True)]
        last = [asdict(change(a, b)) for a, b in zip(errors[max(k - 1, 0)], errors[k], strict=True)]
        rows.append({"name": name, "from_first": first, "from_before": last, "values": values(models[k])})
    return rows


def decoys(saved: Model, windows: Sequence[Window], case: Case) -> list[dict[str, Any]]:
    """Return what effects that were not accepted change on top of the saved model."""
    held, found = {a.effect.name for a in saved.effects}, []
    for name in DECOYS[case.part]:
        if name in held:
            found.append({"name": name, "accepted": True, "changes": [], "values": {}})
            continue
        print(f"{case.title}: decoy {name}", flush=True)
        added = fitted(saved, [chosen(name, saved)], windows)
        changes = [asdict(change(j.errors(saved), j.errors(added))) for j in case.judges]
        found.append({"name": name, "accepted": False, "changes": changes, "values": values(added, name)})
    return found


def ladder(given: Model, windows: Sequence[Window], case: Case) -> list[dict[str, Any]]:
    """Fit the effects of the literature, step by step, without any choice, and judge each step."""
    first, ranks, alone = LADDERS[case.part]
    names, models = [first], [fitted(given, [], windows)]
    for added in ranks:
        print(f"{case.title}: literature, {' and '.join(added)}", flush=True)
        models.append(fitted(models[-1], [chosen(name, case.model) for name in added], windows))
        names.append("+ " + " and ".join(added))
    rows = judged(names, models, case.judges)
    for added in alone:
        more = fitted(models[-1], [chosen(name, case.model) for name in added], windows)
        rows.append(judged(["", f"+ {added[0]}, on top"], [models[-1], more], case.judges)[1])
    return rows


def chosen(name: str, model: Model) -> Effect:
    """Return an effect on what it concerns in these scenes."""
    kind = effect_class(name)
    if kind.kind == "sensor":
        return kind(*kind.targets(model.compile())[0])
    target = {"joint": (JOINT,), "actuator": (DRIVE,), "body": ("cube",), "none": ()}
    return kind(*target[kind.kind])


def fitted(model: Model, added: Sequence[Effect], windows: Sequence[Window]) -> Model:
    """Return a model with more effects, all parameters fitted to windows together with the initial states."""
    prediction = Prediction(model, added, windows, threads=1)
    solver = Solver(prediction, LeastSquaresCfg(iterations=15))
    return prediction.model(solver.polish(solver.fit()).values)


def values(model: Model, only: str = "") -> dict[str, float]:
    """Return the parameters of the effects of a model, of those alone that have a name where one is given."""
    m = replace(model, effects=()).compile()
    return {
        f"{a.effect.name}.{p.name}": float(v)
        for a in model.effects
        if not only or a.effect.name == only
        for p, v in zip(a.effect.parameters(m), a.values, strict=True)
        if np.isfinite(v)
    }


def processor_seconds() -> float:
    """Return the processor time of this process and of its ended children [s]."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def end_workers() -> None:
    """End the processes that joblib keeps, so that their time is known."""
    from joblib.externals.loky import get_reusable_executor

    get_reusable_executor().shutdown(wait=True)


if __name__ == "__main__":
    main(tyro.cli(Args))
