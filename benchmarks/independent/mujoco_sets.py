"""Data sets of the world on MuJoCo: which effects, on which rigs, how large."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from benchmarks.independent.data_set import SIZES, DataSet, Kind, Size, number

Values = tuple[float, float, float]
MAGNITUDES: dict[str, dict[str, Values]] = {
    "pendulum": {
        "joint_friction": (0.015, 0.035, 0.08),
        "stribeck_friction": (0.02, 0.045, 0.1),
        "load_friction": (0.05, 0.11, 0.25),
        "joint_damping": (0.006, 0.014, 0.035),
        "armature": (3e-4, 7e-4, 1.6e-3),
        "actuator_gain": (0.94, 0.87, 0.7),
        "actuator_saturation": (0.95, 0.85, 0.75),
        "actuator_delay": (0.003, 0.007, 0.016),
        "actuator_lag": (0.003, 0.007, 0.016),
        "backlash": (0.006, 0.014, 0.035),
        "joint_compliance": (0.015, 0.03, 0.06),
        "joint_offset": (0.02, 0.04, 0.09),
        "mass": (1.06, 1.14, 1.35),
        "sensor_bias": (0.004, 0.009, 0.02),
        "sensor_gain": (0.008, 0.018, 0.04),
        "latency": (0.003, 0.006, 0.014),
        "gravity_compensation": (0.08, 0.18, 0.4),
        "cogging": (0.015, 0.03, 0.07),
        "warming": (0.03, 0.06, 0.13),
        "dropout": (0.25, 0.35, 0.5),
        "cable": (15.0, 30.0, 60.0),
    },
    "arm": {
        "joint_friction": (1.2, 2.5, 5.0),
        "joint_damping": (1.8, 4.0, 9.0),
        "armature": (0.35, 0.8, 1.8),
        "gravity_compensation": (0.08, 0.18, 0.4),
        "actuator_gain": (0.9, 0.8, 0.6),
        "actuator_delay": (0.004, 0.009, 0.02),
        "actuator_lag": (0.004, 0.009, 0.02),
        "backlash": (0.002, 0.005, 0.012),
        "joint_compliance": (1.5e-4, 3e-4, 7e-4),
        "joint_offset": (0.003, 0.007, 0.016),
        "length_scale": (0.004, 0.009, 0.02),
        "frame_offset": (8e-4, 0.0018, 0.004),
        "time_base": (0.0015, 0.0035, 0.008),
        "cogging": (1.0, 2.2, 5.0),
        "warming": (2.0, 4.0, 8.0),
    },
    "slide": {
        "sliding_friction": (0.33, 0.37, 0.45),
        "anisotropic_friction": (1.15, 1.35, 1.8),
        "gravity_tilt": (0.013, 0.03, 0.07),
        "length_scale": (0.006, 0.013, 0.03),
        "frame_offset": (0.002, 0.0045, 0.01),
        "patch": (0.06, 0.14, 0.3),
        "magnet": (0.12, 0.28, 0.6),
    },
    "spin": {
        "torsional_friction": (0.0012, 0.0015, 0.0022),
        "rolling_friction": (5e-4, 7e-4, 0.0011),
        "magnet": (0.006, 0.014, 0.03),
        "cable": (0.05, 0.12, 0.3),
    },
    "push": {
        "sliding_friction": (0.42, 0.54, 0.85),
        "mass": (1.2, 1.47, 2.2),
        "joint_friction": (0.5, 1.1, 2.4),
        "joint_damping": (3.0, 6.5, 14.0),
        "armature": (0.4, 0.9, 2.2),
        "actuator_gain": (0.85, 0.7, 0.45),
        "actuator_delay": (0.003, 0.007, 0.016),
        "actuator_lag": (0.003, 0.007, 0.016),
        "backlash": (6e-4, 0.0014, 0.003),
        "joint_offset": (0.0012, 0.0025, 0.006),
        "center_of_mass": (0.012, 0.02, 0.028),
        "size": (1.02, 1.045, 1.1),
        "adhesion": (0.3, 0.7, 1.7),
        "frame_offset": (8e-4, 0.0018, 0.004),
        "time_base": (0.003, 0.007, 0.016),
        "latency": (0.012, 0.028, 0.06),
        "sensor_gain": (0.0015, 0.0035, 0.008),
        "cable": (0.8, 1.8, 4.0),
        "cogging": (0.3, 0.7, 1.6),
        "tilted_face": (0.0015, 0.003, 0.006),
        "worn_edge": (0.004, 0.008, 0.016),
        "chamfer": (0.003, 0.006, 0.01),
    },
    "drop": {
        "air_drag": (3.0, 7.0, 16.0),
        "wind": (1.5, 3.0, 6.0),
        "contact_compliance": (1.06, 1.14, 1.4),
        "time_base": (0.006, 0.013, 0.03),
        "length_scale": (0.007, 0.015, 0.035),
        "gravity_tilt": (0.008, 0.018, 0.04),
        "size": (1.03, 1.07, 1.15),
        "frame_offset": (0.002, 0.0045, 0.01),
    },
    "tumble": {
        "center_of_mass": (0.004, 0.008, 0.015),
        "inertia": (1.15, 1.3, 1.7),
        "size": (1.03, 1.06, 1.12),
        "contact_compliance": (0.93, 0.85, 0.7),
        "sliding_friction": (0.5, 0.65, 0.9),
        "slosh": (0.04, 0.08, 0.16),
        "tilted_base": (0.002, 0.004, 0.008),
        "worn_edge": (0.004, 0.008, 0.014),
        "chamfer": (0.003, 0.006, 0.01),
    },
    "grasp": {
        "grip_force": (0.5, 0.45, 0.43),  # the block slips; below, it is lost on some motions
        "pad_friction": (0.28, 0.27, 0.26),  # likewise
        "mass": (1.2, 1.47, 1.7),
        "joint_friction": (1.2, 2.5, 5.0),
        "joint_damping": (6.0, 14.0, 30.0),
        "gravity_compensation": (0.14, 0.29, 0.7),
        "size": (1.015, 1.03, 1.06),
        "actuator_delay": (0.004, 0.009, 0.02),
        "cogging": (1.0, 2.2, 5.0),
        "chamfer": (0.001, 0.002, 0.004),
    },
    "insertion": {
        "joint_friction": (0.8, 1.6, 3.5),
        "actuator_gain": (0.85, 0.7, 0.5),
        "frame_offset": (8e-4, 0.0018, 0.004),
        "cogging": (1.0, 2.2, 5.0),
        "wrong_hole": (5e-4, -5e-4, -9e-4),
        "tilted_face": (3e-4, 6e-4, 9e-4),
    },
}
"""By rig, by effect: value of the main parameter when small, middle and large. The limit of saturation is in units of
the largest force of the drives in the motion; what acts on several drives is that of the strongest."""

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
"""Rig of each effect, on which it is tried in all three sizes."""
ELSEWHERE: tuple[tuple[str, str], ...] = (
    ("arm", "joint_friction"),
    ("arm", "actuator_gain"),
    ("arm", "joint_damping"),
    ("arm", "armature"),
    ("arm", "joint_compliance"),
    ("arm", "actuator_delay"),
    ("push", "joint_friction"),
    ("push", "sliding_friction"),
    ("push", "mass"),
    ("push", "backlash"),
    ("push", "center_of_mass"),
    ("slide", "frame_offset"),
    ("slide", "length_scale"),
    ("drop", "gravity_tilt"),
    ("drop", "frame_offset"),
    ("tumble", "contact_compliance"),
    ("tumble", "sliding_friction"),
    ("tumble", "size"),
    ("grasp", "joint_friction"),
    ("grasp", "size"),
    ("insertion", "joint_friction"),
    ("insertion", "frame_offset"),
    ("insertion", "actuator_gain"),
)
"""Rig and effect: other rigs, middle and large."""
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
    ("arm", "warming"),
    ("spin", "magnet"),
    ("spin", "cable"),
    ("grasp", "cogging"),
)
"""Rig and what no library has: middle and large."""
PAIRS: tuple[tuple[str, str, str], ...] = (
    ("pendulum", "joint_friction", "mass"),
    ("pendulum", "joint_damping", "actuator_delay"),
    ("pendulum", "backlash", "joint_friction"),
    ("pendulum", "armature", "load_friction"),
    ("pendulum", "actuator_gain", "joint_friction"),
    ("pendulum", "stribeck_friction", "actuator_lag"),
    ("pendulum", "joint_compliance", "joint_damping"),
    ("pendulum", "sensor_gain", "joint_friction"),
    ("arm", "joint_friction", "gravity_compensation"),
    ("arm", "joint_damping", "frame_offset"),
    ("arm", "armature", "joint_offset"),
    ("slide", "sliding_friction", "gravity_tilt"),
    ("slide", "anisotropic_friction", "frame_offset"),
    ("slide", "gravity_tilt", "length_scale"),
    ("spin", "rolling_friction", "torsional_friction"),
    ("push", "sliding_friction", "actuator_delay"),
    ("push", "joint_friction", "frame_offset"),
    ("push", "mass", "joint_damping"),
    ("drop", "air_drag", "contact_compliance"),
    ("drop", "length_scale", "gravity_tilt"),
    ("drop", "wind", "size"),
    ("tumble", "center_of_mass", "sliding_friction"),
    ("grasp", "mass", "joint_friction"),
    ("insertion", "joint_friction", "frame_offset"),
)
"""Rig and two effects of the middle size at once."""
GEOMETRY: tuple[tuple[str, tuple[str, ...], tuple[Size, ...]], ...] = (
    ("tumble", ("worn_edge",), ("middle", "large")),
    ("tumble", ("tilted_base",), ("middle", "large")),
    ("tumble", ("chamfer",), ("large",)),
    ("push", ("tilted_face",), ("middle", "large")),
    ("push", ("worn_edge",), ("large",)),
    ("push", ("chamfer",), ("large",)),
    ("grasp", ("chamfer",), ("large",)),
    ("insertion", ("wrong_hole",), ("small", "large")),
    ("insertion", ("tilted_face",), ("large",)),
    ("tumble", ("worn_edge", "sliding_friction"), ("large",)),
    ("tumble", ("tilted_base", "sliding_friction"), ("large",)),
    ("push", ("tilted_face", "sliding_friction"), ("large",)),
    ("push", ("tilted_face", "joint_friction"), ("large",)),
    ("insertion", ("wrong_hole", "joint_friction"), ("large",)),
)
"""Rig, shapes that differ, and friction beside them."""
NULLS: dict[str, int] = {
    "pendulum": 5, "arm": 4, "slide": 5, "spin": 4, "push": 4, "drop": 5, "tumble": 4, "grasp": 3, "insertion": 2,
}  # fmt: skip
"""How many data sets of each rig have nothing hidden."""


def mujoco_sets() -> list[DataSet]:
    """Return all data sets of this world, in a fixed order.

    The name decides the seed, whether noise is stated (half of the sets), and whether there are two demonstrations (a
    third of the sets, none of insertions).
    """
    return [
        replace(
            case,
            seed=int(1e6 * number(case.name)),
            noise_stated=number(f"noise/{case.name}") < 0.5,
            demonstrations=1 + (case.rig != "insertion" and number(f"twice/{case.name}") < 1 / 3),
        )
        for case in (*_nulls(), *_singles(), *_outside(), *_pairs(), *_geometry())
    ]


def _set(rig: str, kind: Kind, effects: Iterable[str], size: Size | None, number: int | None = None) -> DataSet:
    """Return a data set of some effects of one size, or one of several in which nothing is hidden."""
    effects = tuple(effects)
    words = (rig, "+".join(effects) or "null", size or str(number))
    magnitudes = {} if size is None else {e: MAGNITUDES[rig][e][SIZES.index(size)] for e in effects}
    return DataSet("-".join(words), "mujoco", kind, rig, magnitudes, size=size)


def _nulls() -> list[DataSet]:
    return [_set(rig, "null", (), None, k) for rig, count in NULLS.items() for k in range(count)]


def _singles() -> list[DataSet]:
    best = [_set(rig, "single", (effect,), size) for effect, rig in BEST.items() for size in SIZES]
    return best + [_set(rig, "single", (effect,), size) for rig, effect in ELSEWHERE for size in SIZES[1:]]


def _outside() -> list[DataSet]:
    return [_set(rig, "outside", (effect,), size) for rig, effect in OUTSIDE for size in SIZES[1:]]


def _pairs() -> list[DataSet]:
    return [_set(rig, "pair", effects, "middle") for rig, *effects in PAIRS]


def _geometry() -> list[DataSet]:
    return [_set(rig, "geometry", effects, size) for rig, effects, sizes in GEOMETRY for size in sizes]
