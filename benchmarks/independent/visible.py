"""Prints by how much the hidden effect explains a recording better than the model as given.

python -m benchmarks.independent.visible tumble-inertia-small drop-time_base-small
python -m benchmarks.independent.visible --recordings FOLDER drake-roll-sliding_friction-large

For each development set with one hidden effect that the library has: the gain in log likelihood, initial states fitted,
over the windows of a diagnosis, of the effect from its true value on, over the model as given; of both beside nominal
values within their tolerance; and of both where errors of impacts count as noise. Below about 10 the recording hardly
shows the effect, however it is diagnosed. Where noise is not stated it is as estimated, and as large as it may be in
brackets.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from benchmarks.independent.data_set import Data, DataSet
from benchmarks.independent.kept_data import is_kept, load
from benchmarks.independent.split import locked_names
from benchmarks.independent.worlds import all_sets, make
from concent_warp.comparison.residuals import instrument_noise
from concent_warp.diagnosis.candidates.baseline import fitted_model
from concent_warp.diagnosis.candidates.candidate import FittedModel
from concent_warp.diagnosis.candidates.candidates import candidates
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.procedure import Procedure
from concent_warp.diagnosis.search.adequacy import least_ratio
from concent_warp.effects.effect import AddedEffect
from concent_warp.fit.effects.nominal import possible_nominal_effects
from concent_warp.model import Model

PARTS = {"worn_edge": "edge_x+z-"}
"""Part of a body that a hidden change of its shape is, where the library has it."""


@dataclass(frozen=True)
class Args:
    """Command line."""

    names: tyro.conf.Positional[tuple[str, ...]]
    """Development sets with one hidden effect."""
    recordings: Path | None = None
    """Folder of data sets that were made elsewhere; what it lacks is made here."""


def main(args: Args) -> None:
    """Print a line for each data set."""
    known = {c.name: c for c in all_sets() if c.name not in locked_names() and len(c.magnitudes) == 1}
    if unknown := sorted(set(args.names) - set(known)):
        wrong = ", ".join(unknown)
        raise SystemExit(
            f"independent benchmark: no development set with one hidden effect is called {wrong}; python -m"
            " benchmarks.independent.data_sets --list prints all"
        )
    for name in args.names:
        case = known[name]
        kept = args.recordings is not None and is_kept(case, args.recordings)
        data = load(case, args.recordings) if kept and args.recordings is not None else make(case)
        print(f"{name:40s} {visible(case, data)}", flush=True)


def visible(case: DataSet, data: Data) -> str:
    """Return what the hidden effect of a data set gains, in words."""
    procedure = Procedure(Model(data.scene), data.recording, DiagnoseCfg(jobs=1, seed=case.seed, explain=False))
    noises = instrument_noise(procedure.model.compile(), data.recording.demonstrations)
    given = procedure.baseline()
    largest = least_ratio(given, {channel: noise.factor for channel, noise in noises.items()})
    loosened = (given.ratio / largest) ** 2
    if (truth := true_effect(case, data, procedure.model)) is None:
        return "the library lacks the effect"
    parts = [f"{sum(w.count for w in given.windows)} samples, {given.ratio:.2f} x noise"]
    rough = procedure.baseline_with_errors_of_impacts(given, [given])
    for words, base in (("", given), (" where impacts err", rough)):
        if base is None:
            continue
        for beside, nominal in ((words, False), (f"{words} beside nominal values", True)):
            without = refitted(base, nominal_values(procedure.model)) if nominal else base
            found = refitted(base, [*(nominal_values(procedure.model, truth) if nominal else []), truth])
            gain = without.fit.cost - found.fit.cost
            bracket = "" if case.noise_stated else f" [{gain / loosened:.0f}]"
            parts.append(f"{gain:.0f}{bracket}{beside}")
    return "; ".join(parts)


def true_effect(case: DataSet, data: Data, model: Model) -> AddedEffect | None:
    """Return the hidden effect as the library has it, None where it does not."""
    (hidden,) = case.magnitudes.items()
    (truth,) = data.truth
    compiled, part = model.compile(), PARTS.get(hidden[0])
    for effect in candidates(model, {c for d in data.recording.demonstrations for c in d.measured}):
        same = effect.name == truth.effect and (not effect.target or set(effect.target) & set(truth.target))
        if not same or effect.is_part != (part is not None) or (part is not None and part not in effect.target):
            continue
        values = []
        for p in effect.parameters(compiled):
            value = truth.parameters.get(p.name, truth.parameters.get(p.name.split("[")[0], p.null))
            values.append(hidden[1] if part is not None else value if np.isfinite(value) else p.high)
        return AddedEffect(effect, tuple(values))
    return None


def nominal_values(model: Model, beside: AddedEffect | None = None) -> list[AddedEffect]:
    """Return all nominal values of a model but those that an effect stands for."""
    compiled = model.compile()
    return [
        AddedEffect(kind, tuple(p.null for p in kind.parameters(compiled)))
        for kind in possible_nominal_effects(model)
        if beside is None or kind.part_of != beside.effect.name
    ]


def refitted(base: FittedModel, effects: list[AddedEffect]) -> FittedModel:
    """Return a fitted model with effects, from their values and its initial states on, all fitted again."""
    solver = replace(base, model=replace(base.model, effects=tuple(effects))).solver()
    fit = solver.polish(solver.fit(None, *solver.fit_initial_states(solver.p.start, base.fit.offsets)), thorough=True)
    return fitted_model(solver.p.model(fit.values), base.windows, base.blocks, fit, base.engine, base.cfg)


if __name__ == "__main__":
    main(tyro.cli(Args))
