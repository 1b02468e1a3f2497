"""The data sets of the world on Bullet, and how to make them.

python -m benchmarks.independent.bullet_world  # residual of the nominal model over the noise, and with the true effects
python -m benchmarks.independent.bullet_world --kinds null --rigs lift shove

The table is that of `drake_world`. Making a data set needs Bullet (the extra `benchmarks`).

The ratio of the nominal model is 1.0 to 1.2 in `shove`, `lob` and `ramp`, 1.4 in `poke`, and 1.5 to 2.0 in `lift` and
`cart`, where nothing is hidden: sampled control with a torque that is held, friction with presliding, MuJoCo's step,
and tolerances. In `cart` it depends on the tolerance of the pendulum's length, which shifts the phase of a free swing;
there are seeds with 3. With true effects it is about the same, but for play in the gears of `lift`: 4 to 7, against 11
to 30 of the nominal model, for teeth meet otherwise than in the library.
"""

from __future__ import annotations

import tyro

from benchmarks.independent.bullet.rigs import BULLET_RIGS
from benchmarks.independent.data_set import Data, DataSet
from benchmarks.independent.foreign.world import Args, ForeignWorld, Values, print_residuals

SINGLES: dict[str, dict[str, Values]] = {
    "lift": {
        "joint_friction": (0.08, 0.25),
        "armature": (0.008, 0.03),
        "actuator_gain": (0.95, 0.85),
        "backlash": (0.01, 0.03),
        "mass": (1.08, 1.25),
        "gravity_compensation": (0.08, 0.25),
        "sensor_gain": (0.004, 0.012),
    },
    "cart": {
        "joint_damping": (1.0, 4.0),
        "actuator_delay": (0.003, 0.008),
        "gravity_tilt": (0.006, 0.02),
        "time_base": (0.001, 0.003),
    },
    "shove": {
        "sliding_friction": (0.285, 0.34),
        "gravity_tilt": (0.015, 0.04),
        "length_scale": (0.06, 0.1),
    },
    "poke": {
        "sliding_friction": (0.4, 0.6),
        "joint_damping": (6.0, 20.0),
        "actuator_lag": (0.006, 0.02),
        "frame_offset": (0.0015, 0.004),
        "latency": (0.012, 0.03),
    },
    "lob": {
        "air_drag": (1.0, 2.5),
        "wind": (2.0, 4.0),
        "contact_compliance": (0.13, 0.16),
        "length_scale": (0.012, 0.03),
    },
    "ramp": {
        "rolling_friction": (8e-5, 2e-4),
        "gravity_tilt": (0.004, 0.01),
        "inertia": (1.35, 1.6),
    },
}
"""Middle and large value of the main parameter of each effect, by rig, in the units of `foreign.hidden`."""
PAIRS: tuple[tuple[str, str, str], ...] = (
    ("lift", "joint_friction", "gravity_compensation"),
    ("lift", "armature", "actuator_gain"),
    ("cart", "joint_damping", "actuator_delay"),
    ("shove", "sliding_friction", "gravity_tilt"),
    ("poke", "sliding_friction", "frame_offset"),
    ("lob", "air_drag", "contact_compliance"),
    ("ramp", "rolling_friction", "gravity_tilt"),
)
"""Rig and two effects at once, both at their large value."""
OUTSIDES: tuple[tuple[str, str, float], ...] = (
    ("lift", "cogging", 0.15),
    ("lift", "cable", 0.8),
    ("lift", "warming", 0.2),
    ("cart", "faltering", 1.0),
    ("poke", "cogging", 1.5),
    ("shove", "magnet", 0.3),
    ("shove", "sticky_spot", 0.6),
    ("lob", "gust", 0.06),
    ("ramp", "magnet", 0.02),
    ("ramp", "sticky_spot", 0.1),
)
"""Rig, what the library lacks, and its magnitude in the units of `foreign.outside`."""
BULLET = ForeignWorld("bullet", BULLET_RIGS, SINGLES, PAIRS, OUTSIDES)


def bullet_sets() -> list[DataSet]:
    """Return all data sets, in a fixed order, with names that differ."""
    return BULLET.sets()


def make_bullet(case: DataSet) -> Data:
    """Return the recordings of a data set, the user's scene, and the truth; the same each time."""
    return BULLET.make(case)


if __name__ == "__main__":
    print_residuals(BULLET, tyro.cli(Args))
