"""A world on another engine than MuJoCo: its data sets, how they are made, and how far nominal models are from them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module

import numpy as np

from benchmarks.diagnose.hidden_effects_residual import ratios
from benchmarks.independent.data_set import Data, DataSet, Kind, Size, Truth, World
from benchmarks.independent.foreign.hidden import INSIDE
from benchmarks.independent.foreign.outside import OUTSIDE
from benchmarks.independent.foreign.recording import Made, record
from benchmarks.independent.foreign.rig import ForeignRig, Simulate, true_physics
from concent_warp.effects.registry import effect_class
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Recording
from concent_warp.scene.scene import Scene

Values = tuple[float, float]
HELD_OUT_SEED = 50_000
"""Added to a data set's seed for motions, clocks and noise of its held-out recording."""
NULL_SEEDS = (0, 1)


@dataclass(frozen=True)
class ForeignWorld:
    """Experiments on one engine, and what is hidden in them."""

    name: World
    rigs: Mapping[str, ForeignRig]
    singles: Mapping[str, Mapping[str, Values]]
    """Middle and large value of the main parameter of each effect, by rig, in the units of `foreign.hidden`."""
    pairs: Sequence[tuple[str, str, str]]
    """Rig and two effects at once, both at their large value."""
    outsides: Sequence[tuple[str, str, float]]
    """Rig, what the library lacks, and its magnitude in the units of `foreign.outside`."""

    def sets(self) -> list[DataSet]:
        """Return all data sets, in a fixed order, with names that differ.

        Of the effects of a rig every other one has the large value, and every third one both; noise is stated in every
        other data set of a kind.
        """
        found = [
            DataSet(f"{self.name}-{rig}-null-{seed}", self.name, "null", rig, {}, seed)
            for rig in self.rigs
            for seed in NULL_SEEDS
        ]
        for rig, effects in self.singles.items():
            for k, (effect, values) in enumerate(effects.items()):
                for j, size in enumerate(("middle", "large")):
                    if k % 3 == 0 or k % 2 == j:
                        found.append(self._set(rig, "single", {effect: values[j]}, size, 10 + k))
        for k, (rig, first, second) in enumerate(self.pairs):
            both = {effect: self.singles[rig][effect][1] for effect in (first, second)}
            found.append(self._set(rig, "pair", both, "large", 30 + k))
        for k, (rig, effect, magnitude) in enumerate(self.outsides):
            found.append(self._set(rig, "outside", {effect: magnitude}, "large", 50 + k))
        counts: dict[str, int] = {}
        for k, case in enumerate(found):
            counts[case.kind] = counts.get(case.kind, -1) + 1
            found[k] = replace(case, noise_stated=counts[case.kind] % 2 == 0)
        return found

    def _set(self, rig: str, kind: Kind, magnitudes: dict[str, float], size: Size, seed: int) -> DataSet:
        name = f"{self.name}-{rig}-{'+'.join(magnitudes)}-{size}"
        return DataSet(name, self.name, kind, rig, magnitudes, seed, size=size)

    def make(self, case: DataSet) -> Data:
        """Return the recordings of a data set, the user's scene, and the truth; the same each time."""
        recorded, truth = self._hidden(case)
        made, held_out = recorded(case.seed, case.demonstrations), recorded(case.seed + HELD_OUT_SEED, 1)
        recording = made.recording if case.noise_stated else _without_noise_std(made.recording)
        return Data(recording, held_out.recording, self.rigs[case.rig].scene, truth)

    def with_starts(self, case: DataSet) -> tuple[Recording, Scene, tuple[Truth, ...]]:
        """Return the recording of a data set with noise, true initial states and no gaps, its scene, and the truth."""
        recorded, truth = self._hidden(case)
        made, known = recorded(case.seed, case.demonstrations), []
        for d, start in zip(made.recording.demonstrations, made.starts, strict=True):
            seen = {name: _without_gaps(channel) for name, channel in d.measured.items()}
            begun = {} if start is None else {"qpos": start[0], "qvel": start[1]}
            known.append(replace(d, measured=seen, **begun))
        return replace(made.recording, demonstrations=tuple(known)), self.rigs[case.rig].scene, truth

    def _hidden(self, case: DataSet) -> tuple[Callable[[int, int], Made], tuple[Truth, ...]]:
        """Return what records a data set, given a seed and a number of demonstrations, and the truth."""
        simulate: Simulate = import_module(f"benchmarks.independent.{self.name}.simulation").simulate
        rig = self.rigs[case.rig]
        physics = true_physics(rig, case.seed)
        truth = tuple((INSIDE | OUTSIDE)[name](rig, physics, value) for name, value in case.magnitudes.items())
        return lambda seed, demonstrations: record(rig, physics, simulate, seed, demonstrations), truth


def _without_noise_std(recording: Recording) -> Recording:
    """Return a recording whose channels do not state their noise."""
    demonstrations = (
        replace(d, measured={name: replace(channel, noise_std=None) for name, channel in d.measured.items()})
        for d in recording.demonstrations
    )
    return replace(recording, demonstrations=tuple(demonstrations))


def _without_gaps(channel: Channel) -> Channel:
    """Return the rows of a channel that have all values."""
    rows = np.isfinite(channel.value).all(axis=1)
    return replace(channel, time=channel.time[rows], value=channel.value[rows])


def true_model(scene: Scene, truth: tuple[Truth, ...]) -> Model | None:
    """Return the nominal model with the library's effects at the true values; None where it has none to add."""
    if not truth or not all(t.known and t.parameters for t in truth):
        return None
    model = Model(scene)
    for t in truth:
        model = model.add(effect_class(t.effect)(*t.target), t.parameters)
    return model


@dataclass(frozen=True)
class Args:
    """Command line."""

    kinds: tuple[Kind, ...] = ("null", "single", "pair", "outside")
    rigs: tuple[str, ...] = ()
    """Rigs; all by default."""
    contains: str = ""
    """Only data sets whose names contain this."""


def print_residuals(world: ForeignWorld, args: Args) -> None:
    """Print the residual over noise of the nominal model on each data set, and with the true effects."""
    print(f"{'data set':52s} {'time':>6s} {'nominal':>8s} {'truth':>7s}  nominal, by channel")
    for case in world.sets():
        if case.kind not in args.kinds or (args.rigs and case.rig not in args.rigs) or args.contains not in case.name:
            continue
        began = time.perf_counter()
        recording, scene, truth = world.with_starts(case)
        spent = time.perf_counter() - began
        ratio = ratios(Model(scene), recording)
        model = true_model(scene, truth)
        best = "-" if model is None else f"{max(ratios(model, recording).values()):.2f}"
        worst = sorted(ratio.items(), key=lambda item: -item[1])
        listed = ", ".join(f"{name} {value:.1f}" for name, value in worst[:4])
        print(f"{case.name:52s} {spent:5.1f}s {worst[0][1]:8.2f} {best:>7s}  {listed}", flush=True)
