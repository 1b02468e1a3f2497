"""Data sets with a hidden effect: small experiments in Reality, by name and seed, made in seconds each.

python -m benchmarks.diagnose.hidden_effects_data  # residual of the nominal model over the noise
python -m benchmarks.diagnose.hidden_effects_data --kinds null pair  # some of them: single, null, outside, pair
python -m benchmarks.diagnose.hidden_effects_data --rigs slide drop

The table has, for each data set, the time to make it, and the root mean square of residual over noise in the channels
where it is largest, with refitted initial states (`hidden_effects_residual`): for the nominal model, and for the
nominal model with the library's effects at the true values, where the library has them.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import tyro

from benchmarks.diagnose.hidden_effects_residual import ratios
from concent_warp.effects.registry import effect_class
from concent_warp.model import Model
from concent_warp.reality.hidden.drives import peak_drive_force
from concent_warp.reality.hidden.registry import INSIDE, hidden
from concent_warp.reality.hidden.sizes import MAGNITUDES, SIZES, Size
from concent_warp.reality.rigs.registry import RIGS
from concent_warp.reality.rigs.rig import record_rig
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene

Kind = Literal["single", "null", "outside", "pair"]
SEEDS = (0, 1)
"""Of the effects on the rig that shows them best; with the second, as several demonstrations."""
NULL_SEEDS = (0, 1, 2)

BEST: dict[str, str] = {
    "joint_friction": "pendulum",
    "stribeck_friction": "pendulum",
    "load_friction": "pendulum",
    "joint_damping": "pendulum",
    "armature": "pendulum",
    "actuator_gain": "pendulum",
    "actuator_saturation": "pendulum",
    "actuator_delay": "push",
    "actuator_lag": "pendulum",
    "backlash": "pendulum",
    "joint_compliance": "pendulum",
    "joint_offset": "arm",
    "gravity_compensation": "arm",
    "mass": "grasp",
    "center_of_mass": "tumble",
    "inertia": "tumble",
    "size": "drop",
    "contact_geometry": "push",
    "sliding_friction": "slide",
    "anisotropic_friction": "slide",
    "torsional_friction": "spin",
    "rolling_friction": "spin",
    "contact_compliance": "drop",
    "adhesion": "push",
    "grip_force": "grasp",
    "pad_friction": "grasp",
    "gravity_tilt": "slide",
    "air_drag": "drop",
    "wind": "drop",
    "time_base": "drop",
    "latency": "push",
    "length_scale": "drop",
    "frame_offset": "push",
    "sensor_bias": "pendulum",
    "sensor_gain": "pendulum",
}
"""The rig on which each effect is tried at both sizes and on both seeds, but for those in `ONCE`."""
ONCE = ("actuator_saturation", "contact_geometry", "adhesion", "wind", "sensor_bias", "sensor_gain", "pad_friction")
"""Effects tried on one seed, at both sizes: those that others stand for or that start with a jump."""
ELSEWHERE: tuple[tuple[str, str], ...] = (
    ("arm", "joint_friction"),
    ("arm", "actuator_gain"),
    ("push", "joint_friction"),
    ("push", "sliding_friction"),
    ("push", "mass"),
    ("drop", "gravity_tilt"),
    ("drop", "frame_offset"),
    ("tumble", "contact_compliance"),
    ("insertion", "joint_friction"),
    ("insertion", "frame_offset"),
)
"""Rig and effect: the same at the middle size on other rigs, one seed."""
OUTSIDE: tuple[tuple[str, str], ...] = (
    ("pendulum", "cogging"),
    ("pendulum", "warming"),
    ("pendulum", "dropout"),
    ("pendulum", "cable"),
    ("slide", "magnet"),
    ("slide", "patch"),
    ("tumble", "slosh"),
    ("push", "cable"),
    ("push", "cogging"),
    ("arm", "cogging"),
    ("spin", "magnet"),
)
"""Rig and what no library has, at both sizes."""
PAIRS: tuple[tuple[str, str, str], ...] = (
    ("pendulum", "joint_friction", "mass"),
    ("pendulum", "joint_damping", "actuator_delay"),
    ("pendulum", "backlash", "joint_friction"),
    ("pendulum", "armature", "load_friction"),
    ("pendulum", "actuator_gain", "joint_friction"),
    ("arm", "joint_friction", "gravity_compensation"),
    ("slide", "sliding_friction", "gravity_tilt"),
    ("push", "sliding_friction", "actuator_delay"),
    ("push", "joint_friction", "frame_offset"),
    ("drop", "air_drag", "contact_compliance"),
    ("drop", "length_scale", "gravity_tilt"),
    ("grasp", "mass", "joint_friction"),
)
"""Rig and two effects of the middle size at once."""


@dataclass(frozen=True)
class DataSet:
    """A recording to be made."""

    name: str
    kind: Kind
    rig: str
    magnitudes: Mapping[str, float]
    """Value of the main parameter of each hidden effect, by name; of saturation, the limit over `peak_drive_force`."""
    size: Size | None
    seed: int
    demonstrations: int = 1
    """How often the rig's experiment is done; of a rig of throws, each time a set of them."""


@dataclass(frozen=True)
class Truth:
    """What is hidden."""

    effect: str
    parameters: Mapping[str, float]
    """True values, by the parameter's name; none where the effect has none or is outside the library."""
    target: tuple[str, ...]
    """Joints, drives, bodies or sensors concerned."""
    known: bool
    """Whether a library of effects has it."""


@dataclass(frozen=True)
class Data:
    """A recording, the nominal scene, and the truth."""

    recording: Recording
    scene: Scene
    truth: tuple[Truth, ...]
    """One for each hidden effect; empty where nothing is hidden."""


def cases() -> list[DataSet]:
    """Return all data sets, in a fixed order, with names that differ."""
    found = [null(rig, seed) for rig in RIGS for seed in NULL_SEEDS]
    for effect, rig in BEST.items():
        for size in ("middle", "large"):
            for seed in SEEDS[:1] if effect in ONCE else SEEDS:
                found.append(single(rig, effect, size, seed, demonstrations=1 + seed))
    found += [single(rig, effect, "middle", 2) for rig, effect in ELSEWHERE]
    for rig, effect in OUTSIDE:
        for size in ("middle", "large"):
            found.append(single(rig, effect, size, 0, demonstrations=1, kind="outside"))
    for k, (rig, first, second) in enumerate(PAIRS):
        magnitudes = {effect: MAGNITUDES[rig][effect][1] for effect in (first, second)}
        demonstrations = 1 + k % 2
        found.append(
            DataSet(f"{rig}-{first}+{second}-middle-{k}", "pair", rig, magnitudes, "middle", k, demonstrations)
        )
    return found


def null(rig: str, seed: int) -> DataSet:
    """Return data in which nothing is hidden; every second one as two demonstrations."""
    return DataSet(f"{rig}-null-{seed}", "null", rig, {}, None, 100 + seed, 1 + seed % 2)


def single(rig: str, effect: str, size: Size, seed: int, *, demonstrations: int = 1, kind: Kind = "single") -> DataSet:
    """Return data with one hidden effect."""
    magnitude = MAGNITUDES[rig][effect][SIZES.index(size)]
    return DataSet(f"{rig}-{effect}-{size}-{seed}", kind, rig, {effect: magnitude}, size, seed, demonstrations)


def make(case: DataSet) -> Data:
    """Record a data set; the same each time."""
    rig = RIGS[case.rig]
    magnitudes = dict(case.magnitudes)
    if "actuator_saturation" in magnitudes:
        magnitudes["actuator_saturation"] *= peak_drive_force(rig, case.demonstrations, case.seed)
    inside = [hidden(name, magnitude, rig) for name, magnitude in magnitudes.items()]
    recording = record_rig(rig, [h.effect for h in inside], case.demonstrations, case.seed)
    truth = tuple(Truth(h.name, dict(h.truth), h.target, h.name in INSIDE) for h in inside)
    return Data(recording, rig.scene, truth)


@dataclass(frozen=True)
class Args:
    """Command line."""

    kinds: tuple[Kind, ...] = ("null", "single", "outside", "pair")
    rigs: tuple[str, ...] = tuple(RIGS)
    seeds: tuple[int, ...] | None = None
    """Only these seeds; by default all."""


def main(args: Args) -> None:
    """Print the residual of the nominal model on each data set."""
    chosen = [c for c in cases() if c.kind in args.kinds and c.rig in args.rigs]
    print(f"{'data set':56s} {'demos':>5s} {'make':>6s} {'nominal':>8s} {'truth':>6s}  nominal, by channel")
    for case in chosen:
        if args.seeds is not None and case.seed not in args.seeds:
            continue
        start = time.perf_counter()
        data = make(case)
        spent = time.perf_counter() - start
        ratio = ratios(Model(data.scene), data.recording)
        model = true_model(data)
        best = "-" if model is None else f"{max(ratios(model, data.recording).values()):.2f}"
        worst = sorted(ratio.items(), key=lambda item: -item[1])
        listed = ", ".join(f"{name} {value:.1f}" for name, value in worst[:3])
        count = len(data.recording.demonstrations)
        print(f"{case.name:56s} {count:5d} {spent:5.1f}s {worst[0][1]:8.2f} {best:>6s}  {listed}", flush=True)


def true_model(data: Data) -> Model | None:
    """Return the nominal model with the library's effects at the true values; None where there is nothing to add."""
    if not data.truth or not all(t.known and t.parameters for t in data.truth):
        return None
    model = Model(data.scene)
    for t in data.truth:
        model = model.add(effect_class(t.effect)(*t.target), t.parameters)
    return model


if __name__ == "__main__":
    main(tyro.cli(Args))
