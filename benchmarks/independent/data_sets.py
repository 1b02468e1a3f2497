"""What the data sets look like: residuals of the nominal model, and of it with the library's effects at true values.

python -m benchmarks.independent.data_sets --list                  # names only; nothing is made
python -m benchmarks.independent.data_sets --kinds null --rigs arm # residuals of some sets
python -m benchmarks.independent.data_sets --save FOLDER           # recordings, for a machine without Drake or Bullet

The table has, for each data set, the time to make it, and the root mean square of residual over noise in the channel
where it is largest, initial states refitted: of the nominal model, and of the nominal model with the library's effects
at their true values, where these exist. Locked sets are not shown, and made with `--save` and `--locked` only.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from benchmarks.diagnose.hidden_effects_residual import ratios
from benchmarks.independent.data_set import KINDS, WORLDS, Data, DataSet, Kind, World
from benchmarks.independent.kept_data import is_kept, save
from benchmarks.independent.split import locked_by_rule
from benchmarks.independent.worlds import all_sets, make
from concent_warp.effects.registry import effect_class
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Recording


@dataclass(frozen=True)
class Args:
    """Command line."""

    list: bool = False
    """Print names and counts only."""
    kinds: tuple[Kind, ...] = KINDS
    rigs: tuple[str, ...] = ()
    """Rigs; all by default."""
    world: World | None = None
    names: tuple[str, ...] = ()
    """Only data sets of these names."""
    save: Path | None = None
    """Write the recordings to this folder, those that it lacks, and print no residuals."""
    locked: bool = False
    """Write the locked sets, and no others."""


def main(args: Args) -> None:
    """Print the table."""
    chosen = [c for c in all_sets() if _wanted(c, args)]
    if args.list:
        for case in chosen:
            words = "noise stated" * case.noise_stated, "locked" * locked_by_rule(case)
            print(f"{case.name:52s} {case.kind:9s} {case.demonstrations} {words[0]:12s} {words[1]}".rstrip())
        counts = Counter((c.world, c.kind, locked_by_rule(c)) for c in chosen)
        for world in WORLDS:
            for kind in KINDS:
                locked, rest = counts[world, kind, True], counts[world, kind, False]
                print(f"{world:8s} {kind:9s} {rest:4d} for development, {locked:4d} locked")
        return
    if args.save is not None:
        save_all([c for c in chosen if locked_by_rule(c) == args.locked], args.save)
        return
    print(f"{'data set':52s} {'make':>6s} {'nominal':>8s} {'truth':>6s}  nominal, by channel")
    for case in chosen:
        if locked_by_rule(case):
            continue
        start = time.perf_counter()
        data = make(case)
        spent = time.perf_counter() - start
        nominal, truth = residual_ratios(data)
        worst = sorted(nominal.items(), key=lambda item: -item[1])
        best = "-" if truth is None else f"{max(truth.values()):.2f}"
        listed = ", ".join(f"{name} {value:.1f}" for name, value in worst[:3])
        print(f"{case.name:52s} {spent:5.1f}s {worst[0][1]:8.2f} {best:>6s}  {listed}", flush=True)


def save_all(chosen: Sequence[DataSet], folder: Path) -> None:
    """Make data sets that a folder lacks and write them there."""
    missing = [c for c in chosen if not is_kept(c, folder)]
    for k, case in enumerate(missing):
        save(case, make(case), folder)
        print(f"{k + 1:3d}/{len(missing)} {case.name}", flush=True)


def _wanted(case: DataSet, args: Args) -> bool:
    """Return whether a data set was asked for."""
    return (
        case.kind in args.kinds
        and (not args.rigs or case.rig in args.rigs)
        and args.world in (None, case.world)
        and (not args.names or case.name in args.names)
    )


def residual_ratios(data: Data) -> tuple[dict[str, float], dict[str, float] | None]:
    """Return residuals over noise by channel, of the nominal model and of the one with the true effects.

    The second is None where nothing is hidden or an effect has no true values.
    """
    recording = _complete(data.recording, data.held_out)
    truth = true_model(data)
    return ratios(Model(data.scene), recording), None if truth is None else ratios(truth, recording)


def true_model(data: Data) -> Model | None:
    """Return the nominal model with the library's effects at the true values; None where there are none."""
    if not data.truth or any(not t.known or not t.parameters for t in data.truth):
        return None
    model = Model(data.scene)
    for t in data.truth:
        model = model.add(effect_class(t.effect)(*t.target), t.parameters)
    return model


def _complete(recording: Recording, other: Recording) -> Recording:
    """Return a recording without missing readings, with the noise that another one of the same instruments states."""
    noise = {name: c.noise_std for d in other.demonstrations for name, c in d.measured.items()}

    def complete(name: str, channel: Channel) -> Channel:
        seen = np.isfinite(channel.value).all(axis=1)
        return replace(channel, time=channel.time[seen], value=channel.value[seen], noise_std=noise[name])

    return replace(
        recording,
        demonstrations=tuple(
            replace(d, measured={name: complete(name, c) for name, c in d.measured.items()})
            for d in recording.demonstrations
        ),
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
