"""Which effects does a diagnosis find in measured data, and do they hold on data that it has not seen?

Two sets of measurements, neither of which anything here was tuned to:

- Tosses of a cube on a board (ContactNets; Pfrommer, Halm, Posa, CoRL 2020). The model is the published one: a box with
  the published edge, mass, inertia and friction, on a plane. Some tosses, drawn at random, are diagnosed; others judge.
- Logs of an XL330 servo that swings a payload (BAM; Duclusaud, Passault, Padois, Daney, 2024), at two gains of its
  controller. The model has the motor's constants as they are roughly known, no friction, and a drive strength that is
  fitted from the start. Logs at one gain are diagnosed; those at the other judge, in a model with that gain.

    python -m benchmarks.diagnose.real --data ../shared/data       # both, about half an hour on one core
    python -m benchmarks.diagnose.real --parts servo               # one of them; the page keeps the other's figures
    python -m benchmarks.diagnose.real --table                     # the page again, from the figures

What is killed goes on from its finished pieces, in runs/diagnose_real; empty that folder after a change of the method.

What judges shares nothing with the diagnosis but the simulator: windows of the recordings that were held out, see
`held_out.py`. After each addition the model predicts them; so it does with each decoy added to the final model, fitted
to the same data as the diagnosis had.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from benchmarks.diagnose.real_report import NAME, write_report
from benchmarks.fit.held_out import Spans, by_demonstration, change, cut_spans, prediction_errors
from benchmarks.pages import ROOT, machine, read_data, write_data
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.diagnosis.procedure import Procedure
from concent_warp.effects.effect import Effect
from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.least_squares import LeastSquaresCfg, Solver
from concent_warp.fit.effects.observation import Window
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
DECOYS: dict[Part, tuple[str, ...]] = {
    "tosses": ("air_drag", "torsional_friction", "rolling_friction"),
    "servo": ("stribeck_friction", "actuator_delay"),
}
ADDITIONS: dict[Part, int] = {"tosses": 2, "servo": 3}
"""Most effects that a diagnosis adds."""
LADDER = ((), ("joint_friction", "joint_damping"), ("load_friction",), ("stribeck_friction",), ("actuator_delay",))
"""Effects of servos in the order of the literature, each fitted on top of those before it; the last two each alone."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    data: Path = ROOT.parent / "shared" / "data"
    """Folder with the folders contactnets_cube and bam_xl330."""
    parts: tuple[Part, ...] = ("tosses", "servo")
    fitted: int = 16
    """Tosses that are diagnosed."""
    judged: int = 60
    """Tosses that judge."""
    seed: int = 0
    """Of the split of the tosses."""
    jobs: int = 1
    """Processes of a diagnosis."""
    pieces: Path = ROOT / "runs" / "diagnose_real"
    """Where finished pieces of diagnoses are kept."""
    contrast: bool = False
    """Fit decoys and the ladder again, for the diagnoses that there are."""
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

    def errors(self, model: Model) -> np.ndarray:
        """Return the error of each unit."""
        found = prediction_errors(self.to(model), self.spans, [self.channel])[self.channel] * self.per_unit
        return by_demonstration(found, self.spans.group) if self.grouped else found


def main(args: Args) -> None:
    """Measure, and write data and page."""
    if not args.table:
        missing = [str(args.data / FOLDERS[part]) for part in args.parts if not (args.data / FOLDERS[part]).is_dir()]
        if missing:
            print(f"no measured data in {' and '.join(missing)}; say where they are with --data", file=sys.stderr)
            raise SystemExit(2)
        for part in args.parts:
            begin = time.perf_counter()
            cases = [tosses(args)] if part == "tosses" else [servo(args, kp) for kp in GAINS]
            old = read_data(NAME).get(part, {}).get("studies", []) if args.contrast else []
            if args.contrast:
                studies = [contrasted(found, case, part) for found, case in zip(old, cases, strict=True)]
            else:
                studies = [study(case, part, args) for case in cases]
            spent = time.perf_counter() - begin
            write_data(NAME, {**read_data(NAME), part: {"studies": studies, "seconds": spent, "machine": machine()}})
    write_report(read_data(NAME))


@dataclass(frozen=True)
class Case:
    """A model, what it is diagnosed on, and what judges."""

    title: str
    model: Model
    seen: Recording
    judges: list[Judge]


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
        Judge("position, windows", "mm", 1e3, POSITION, windows, same, True),
        Judge("orientation, windows", "deg", 180 / np.pi, ORIENTATION, windows, same, True),
        Judge("position, whole toss", "mm", 1e3, POSITION, whole, same, True),
    ]
    title = f"{len(seen.demonstrations)} tosses diagnosed, {len(unseen.demonstrations)} others judge"
    return Case(title, model, seen, judges)


def servo(args: Args, kp: float) -> Case:
    """Return the logs at one gain to diagnose, those at the other to judge."""
    other = GAINS[1 - GAINS.index(kp)]
    seen, unseen = (read_bam(args.data / FOLDERS["servo"], kp=gain) for gain in (kp, other))
    model = Model(Scene(seen.scene, seen.source)).add(effect_class("actuator_gain")(DRIVE))
    there = Scene(unseen.scene, unseen.source)

    def moved(m: Model) -> Model:
        return replace(m, scene=there)

    judges = []
    for name, recording, to in ((f"kp {other:g}, held out", unseen, moved), (f"kp {kp:g}, diagnosed", seen, same)):
        spans = cut_spans(to(model), recording, *SERVO_SPAN, moving=MOVING)
        judges.append(Judge(name, "deg", 180 / np.pi, SENSOR, spans, to, False))
    return Case(f"kp {kp:g} diagnosed, kp {other:g} judges", model, seen, judges)


def same(model: Model) -> Model:
    """Return the model itself."""
    return model


def study(case: Case, part: Part, args: Args) -> dict[str, Any]:
    """Diagnose a recording and judge every step, and the decoys on top of the last."""
    title, model, seen, judges = case.title, case.model, case.seen, case.judges
    begin = time.perf_counter()
    cfg = DiagnoseCfg(max_additions=ADDITIONS[part], jobs=args.jobs, explain=False)
    diagnosis = diagnose(
        model, seen, cfg, out=args.pieces, progress=lambda share, text: progress(title, begin, share, text)
    )
    spent = time.perf_counter() - begin
    print(f"\n{title}: {diagnosis.verdict}, {[f.name for f in diagnosis.accepted]}, {spent:.0f} s", flush=True)
    steps = ["as published", *(f"+ {f.name}" for f in diagnosis.accepted)]
    rows = judged(steps, list(diagnosis.models), judges)
    found: dict[str, Any] = {
        "title": title,
        "seconds": spent,
        "judges": [{"name": j.name, "unit": j.unit, "units": len(j.errors(model))} for j in judges],
        "diagnosis": diagnosis.to_json(),
        "steps": rows,
    }
    return contrasted(found, case, part)


def contrasted(found: dict[str, Any], case: Case, part: Part) -> dict[str, Any]:
    """Return a study with decoys added to its final model, and for servos with a ladder of effects, fitted anew."""
    windows = Procedure(case.model, case.seen, DiagnoseCfg()).baseline().windows
    final = rebuilt(case.model, found)
    held = {a.effect.name for a in final.effects}
    decoys = []
    for name in DECOYS[part]:
        if name in held:
            decoys.append({"name": name, "accepted": True, "changes": [], "values": {}})
            continue
        added = fitted(final, [chosen(name)], windows)
        pairs = [change(j.errors(final), j.errors(added)) for j in case.judges]
        decoys.append(
            {"name": name, "accepted": False, "changes": [asdict(c) for c in pairs], "values": values(added, name)}
        )
        print(f"  decoy {name}: {[f'{100 * c.fall:.1f} % p {c.p:.2g}' for c in pairs]}", flush=True)
    found = {**found, "decoys": decoys}
    if part == "servo":
        found["ladder"] = ladder(case.model, windows, case.judges)
    return found


def rebuilt(model: Model, found: dict[str, Any]) -> Model:
    """Return the last model of a study from its figures."""
    known: dict[str, float] = found["steps"][-1]["values"]
    targets = {f["name"].split("(")[0]: f["target"] for f in found["diagnosis"]["effects"] if f["accepted"]}
    model = replace(model, effects=())
    for name in dict.fromkeys(key.split(".", 1)[0] for key in known):
        effect = effect_class(name)(*targets[name]) if name in targets else chosen(name)
        parts = {key.split(".", 1)[1]: value for key, value in known.items() if key.startswith(f"{name}.")}
        model = model.add(effect, parts)
    return model


def progress(title: str, begin: float, share: float, text: str) -> None:
    """Say how far a diagnosis is, on one line."""
    print(f"\r{title}: {100 * share:3.0f} % {text:40s} {time.perf_counter() - begin:5.0f} s", end="", flush=True)


def judged(names: Sequence[str], models: Sequence[Model], judges: Sequence[Judge]) -> list[dict[str, Any]]:
    """Return for each model its errors, against the first one's and against the one's before it."""
    errors = [[j.errors(m) for j in judges] for m in models]
    rows = []
    for k, name in enumerate(names):
        first = [asdict(change(a, b)) for a, b in zip(errors[0], errors[k], strict=True)]
        last = [asdict(change(a, b)) for a, b in zip(errors[max(k - 1, 0)], errors[k], strict=True)]
        rows.append({"name": name, "from_first": first, "from_before": last, "values": values(models[k], "")})
    return rows


def ladder(model: Model, windows: Sequence[Window], judges: Sequence[Judge]) -> list[dict[str, Any]]:
    """Fit what the literature adds to servos, step by step, without any choice, and judge each step."""
    models = [fitted(model, [], windows)]
    names = ["drive strength alone"]
    for added in LADDER[1:3]:
        models.append(fitted(models[-1], [chosen(name) for name in added], windows))
        names.append("+ " + " and ".join(added))
    rows = judged(names, models, judges)
    for added in LADDER[3:]:
        more = fitted(models[-1], [chosen(name) for name in added], windows)
        rows.append(judged(["", f"+ {added[0]}, on top"], [models[-1], more], judges)[1])
    return rows


def chosen(name: str) -> Effect:
    """Return an effect on what it concerns in these scenes."""
    kind = effect_class(name)
    target = {"joint": (JOINT,), "actuator": (DRIVE,), "body": ("cube",), "none": ()}
    return kind(*target[kind.kind])


def fitted(model: Model, added: Sequence[Effect], windows: Sequence[Window]) -> Model:
    """Return a model with more effects, all parameters fitted to windows together with the initial states."""
    prediction = Prediction(model, added, windows, threads=1)
    solver = Solver(prediction, LeastSquaresCfg(iterations=15))
    return prediction.model(solver.polish(solver.fit()).values)


def values(model: Model, only: str) -> dict[str, float]:
    """Return the parameters of the effects of a model, of those alone that have a name where one is given."""
    m = replace(model, effects=()).compile()
    return {
        f"{a.effect.name}.{p.name}": float(v)
        for a in model.effects
        if not only or a.effect.name == only
        for p, v in zip(a.effect.parameters(m), a.values, strict=True)
        if np.isfinite(v)
    }


if __name__ == "__main__":
    main(tyro.cli(Args))
