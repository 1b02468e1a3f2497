"""What the trainings that are compared are made from: models and demonstrations, one of each for every case and seed.

    python -m benchmarks.train.cases --out runs/table1 --processes 8    # 4-6 minutes of a core for each fit

A seed is a demonstration of its own, recorded in Reality, and everything that follows from it. In some cases
a physical effect is hidden in that world. What is made already is not made again.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Literal

import tyro
from joblib import Parallel, delayed

from concent_warp.cli.terminal import quiet_warp
from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.fit import fit_effects
from concent_warp.fit.fit_geometry import FitCfg, fit_geometry
from concent_warp.model import Model
from concent_warp.reality.expert.plan import Task
from concent_warp.reality.hidden.in_task import TaskWorld, parse_effects
from concent_warp.reality.record import RealityCfg, Truth, record
from concent_warp.reality.variation import VariationCfg
from concent_warp.reality.world import WorldCfg
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.load import load_recording
from concent_warp.recording.recording import Recording
from concent_warp.scene.round_peg import RoundPegCfg
from concent_warp.scene.scene import Scene
from concent_warp.scene.shape_sorter import ShapeSorterCfg
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.scene.stacking import StackingCfg

HIDDEN = "actuator_delay=0.1"
"""What is hidden in Reality of some cases: commands that act a tenth of a second late. Demonstrations still
succeed under it, policies that do not know of it fail more often."""
WORLD_OF_TRIALS = WorldCfg(timestep=5e-4, integrator="Euler")
"""Reality as policies are tried in it: shorter steps and another integrator than the model's."""
TASKS: dict[str, Task] = {"shape_sorter": ShapeSorterCfg(), "round_peg": RoundPegCfg(), "stacking": StackingCfg()}
MODEL, DEMONSTRATION, WORLD = "model.toml", "demonstration.h5", "hidden.txt"
ATTEMPTS = 10
"""Demonstrations of a seed that are recorded until one succeeds."""


@dataclass(frozen=True)
class Case:
    """A row of the table."""

    title: str
    geometry: Literal["fitted", "surface", "inset"] = "fitted"
    """Contact geometry: fitted to the demonstration from the inset one, or as laid on the surface or within it."""
    reward: Literal["contact", "engineered"] = "contact"
    world: Literal["plain", "hidden"] = "plain"
    """Whether an effect is hidden where the demonstration is recorded and the policy is tried."""
    added: bool = False
    """Whether the model has the effect, fitted to the demonstration, before its geometry is fitted."""
    randomised: bool = False
    """Whether the model has the effect with an interval that nothing was fitted to: it only is known to be possible."""

    def material(self, seed: int) -> str:
        """Return the name of the folder of model and demonstration."""
        marks = ["hidden"] * (self.world == "hidden") + ["added"] * self.added + ["randomised"] * self.randomised
        return "_".join([self.geometry, *marks, str(seed)])


CASES = {
    "ours": Case("ours"),
    "surface": Case("without contact geometry optimisation", "surface"),
    "inset": Case("without optimisation, spheres inset", "inset"),
    "engineered": Case("without contact-event reward", reward="engineered"),
    "unconstrained": Case("unconstrained", "surface", "engineered"),
    "unaware": Case("ours, an effect hidden", world="hidden"),
    "aware": Case("ours, the hidden effect added", world="hidden", added=True),
    "randomised": Case("ours, the hidden effect randomised", world="hidden", randomised=True),
}


@dataclass(frozen=True)
class Args:
    """Command line."""

    out: Path
    """Folder; models and demonstrations go to its folder models."""
    cases: tuple[str, ...] = tuple(CASES)
    seeds: tuple[int, ...] = (0, 1, 2)
    processes: int = 1
    task: Literal["shape_sorter", "round_peg", "stacking"] = "shape_sorter"
    """What is demonstrated."""
    hidden: str = HIDDEN
    """Effect that is hidden, with its magnitude."""
    spread: tuple[float, float] = (0.0, 0.3)
    """95 % interval of the effect's main parameter where it is only known to be possible."""
    spheres: int = 512
    edges: int = 0
    """Further, smaller spheres along edges."""
    fit: FitCfg = field(default_factory=FitCfg)


def demonstrate(seed: int, hidden: tuple[str, ...], task: Task) -> tuple[Recording, Truth]:
    """Return the first successful demonstration of a seed in Reality, with these effects hidden in it, and its truth.

    Raises:
        SystemExit: None succeeds.
    """
    cfg = RealityCfg(world=WORLD_OF_TRIALS)
    effects = ()
    if hidden:
        fingers = task.robot.gripper_actuators
        world = TaskWorld(task.build(), cfg.world, task.objects[0], fingers, parse_effects(hidden))
        effects = tuple(one.effect for one in world.hidden())
    for number in range(ATTEMPTS):
        found, (truth,) = record(cfg, [1000 * seed + number], task=task, effects=effects, variation=VariationCfg())
        if truth.success:
            return found, truth
    what = " ".join(hidden) or "nothing"
    raise SystemExit(f"seed {seed}: none of {ATTEMPTS} demonstrations succeeds with {what} hidden")


def make(case: Case, seed: int, args: Args) -> None:
    """Make model and demonstration of a case, in one piece or not at all."""
    folder = args.out / "models" / case.material(seed)
    hidden = args.hidden if case.world == "hidden" else ""
    if folder.exists():
        return
    quiet_warp()
    if case.randomised:
        unaware = replace(case, randomised=False)
        make(unaware, seed, args)
        model, recording = material(args.out, unaware, seed)
        keep(folder, with_spread(model, hidden, args.spread), recording, hidden)
        return
    recording, _ = demonstrate(seed, (hidden,) if hidden else (), TASKS[args.task])
    scene = Scene(recording.scene)
    placement = "surface" if case.geometry == "surface" else "inset"
    spheres = ContactGeometryCfg(count=args.spheres, edges=args.edges, placement=placement, seed=seed)
    model = Model(scene, spheres.build(scene))
    if case.added:
        # What acts on the arm shows as well with the shapes as drawn, which are much quicker than spheres.
        drawn, kind = Model(scene), effect_class(args.hidden.split("=")[0])
        for names in kind.targets(drawn.compile()):
            drawn = drawn.add(kind(*names))
        model = replace(model, effects=fit_effects(drawn, recording).model.effects)
        for added in model.effects:
            print(f"{folder.name}: {added.effect.name} {added.values} {added.intervals}", flush=True)
    if case.geometry == "fitted":
        model = fit_geometry(model, recording, replace(args.fit, seed=seed), engine="mujoco").model
    keep(folder, model, recording, hidden)


def with_spread(model: Model, hidden: str, spread: tuple[float, float]) -> Model:
    """Return a model with the effect on all its targets, its main parameter in the middle of an interval."""
    kind = effect_class(hidden.split("=")[0])
    for names in kind.targets(Model(model.scene).compile()):
        model = model.add(kind(*names))
        added = model.effects[-1]
        values = sum(spread) / 2, *added.values[1:]
        uncertain = replace(added, values=values, intervals=(spread, *((value, value) for value in values[1:])))
        model = replace(model, effects=(*model.effects[:-1], uncertain))
    return model


def keep(folder: Path, model: Model, recording: Recording, hidden: str) -> None:
    """Write model and demonstration in one piece or not at all."""
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    model.save(partial / MODEL)
    slim = replace(recording[0], image={})
    write_hdf5(replace(recording, demonstrations=(slim,)), partial / DEMONSTRATION)
    (partial / WORLD).write_text(hidden)
    partial.rename(folder)
    print(f"made {folder.name}", flush=True)


def material(out: Path, case: Case, seed: int) -> tuple[Model, Recording]:
    """Return model and demonstration of a case."""
    folder = out / "models" / case.material(seed)
    return Model.load(folder / MODEL), load_recording(folder / DEMONSTRATION)


def same_world(out: Path, cases: Iterable[str], seeds: Iterable[int], hidden: str) -> None:
    """End with a sentence where models of these cases were made with something else hidden; older ones do not say."""
    for case, seed in product((CASES[name] for name in cases), seeds):
        made = out / "models" / case.material(seed) / WORLD
        if case.world == "hidden" and made.is_file() and made.read_text() != hidden:
            raise SystemExit(f"{made}: the model was made with {made.read_text()} hidden, not {hidden}; pass --hidden")


def main() -> None:
    """Make all that is asked for."""
    args = tyro.cli(Args, description=__doc__)
    same_world(args.out, args.cases, args.seeds, args.hidden)
    wanted_ = {CASES[name].material(seed): (CASES[name], seed) for name in args.cases for seed in args.seeds}
    Parallel(n_jobs=args.processes)(delayed(make)(case, seed, args) for case, seed in wanted_.values())


if __name__ == "__main__":
    main()
