"""The data sets of the world on Drake, and how to make them.

python -m benchmarks.independent.drake_world  # residual of the nominal model over the noise, and with the true effects
python -m benchmarks.independent.drake_world --kinds null --rigs swing launch

The table has, for each data set, the time to make its recording and the root mean square of residual over noise in the
worst channel (`benchmarks.diagnose.hidden_effects_residual`, with refitted initial states): of the nominal model, and
of the nominal model with the library's effects at the true values. Making a data set needs Drake (the extra
`benchmarks`).

The nominal models are not exact where nothing is hidden either. The ratio of `swing` and `reach` is 1.4 to 1.5 (sampled
control with a torque that is held, friction with presliding, tolerances, quantisation), of `launch`, `roll` and `toss`
1.0 to 1.3. Two are larger, since MuJoCo's contacts differ from Coulomb's law there:

- `bounce`, 3 to 4: friction of MuJoCo's contact shares the time constant of its normal force, so it takes 0.12 m/s off
  a ball that bounces at 0.8 m/s where mu (1 + e) v is 0.19 m/s, as in Drake.
- `gantry`, 4 to 7: under the finger's push MuJoCo's block chatters from corner to corner, which changes how far it
  turns; with normal forces at rest, friction turns it as far as in Drake.
"""

from __future__ import annotations

import tyro

from benchmarks.independent.data_set import Data, DataSet
from benchmarks.independent.drake.rigs import DRAKE_RIGS
from benchmarks.independent.foreign.world import Args, ForeignWorld, Values, print_residuals

SINGLES: dict[str, dict[str, Values]] = {
    "swing": {
        "joint_friction": (0.02, 0.05),
        "stribeck_friction": (0.03, 0.08),
        "joint_damping": (0.012, 0.03),
        "armature": (6e-4, 0.002),
        "actuator_gain": (0.93, 0.8),
        "actuator_saturation": (0.4, 0.34),
        "actuator_delay": (0.005, 0.015),
        "actuator_lag": (0.006, 0.02),
        "backlash": (0.015, 0.04),
        "joint_compliance": (0.02, 0.04),
        "joint_offset": (0.03, 0.07),
        "mass": (1.08, 1.25),
        "sensor_gain": (0.01, 0.03),
    },
    "reach": {
        "joint_friction": (0.3, 0.8),
        "joint_damping": (0.5, 1.5),
        "actuator_gain": (0.88, 0.75),
        "actuator_delay": (0.006, 0.02),
        "joint_compliance": (0.001, 0.0025),
        "gravity_compensation": (0.08, 0.2),
        "mass": (1.1, 1.3),
        "length_scale": (0.008, 0.02),
        "frame_offset": (0.002, 0.005),
        "time_base": (0.004, 0.01),
    },
    "gantry": {
        "sliding_friction": (0.5, 0.8),
        "mass": (1.5, 2.5),
        "joint_friction": (1.0, 3.0),
        "joint_damping": (8.0, 25.0),
        "actuator_gain": (0.85, 0.6),
        "actuator_delay": (0.008, 0.025),
        "frame_offset": (0.0015, 0.004),
    },
    "launch": {
        "sliding_friction": (0.36, 0.45),
        "gravity_tilt": (0.035, 0.08),
        "length_scale": (0.06, 0.1),
        "latency": (0.01, 0.025),
    },
    "bounce": {
        "air_drag": (2.5, 5.0),
        "wind": (3.0, 6.0),
        "contact_compliance": (0.13, 0.2),
        "gravity_tilt": (0.035, 0.07),
        "sliding_friction": (0.08, 0.12),
        "length_scale": (0.02, 0.045),
        "time_base": (0.012, 0.03),
    },
    "roll": {
        "rolling_friction": (1e-4, 3e-4),
        "sliding_friction": (0.2, 0.3),
        "gravity_tilt": (0.004, 0.01),
        "inertia": (1.3, 1.67),
        "center_of_mass": (8e-4, 0.002),
    },
    "toss": {
        "center_of_mass": (0.005, 0.012),
        "length_scale": (0.015, 0.035),
        "time_base": (0.012, 0.03),
        "gravity_tilt": (0.03, 0.07),
    },
}
"""Middle and large value of the main parameter of each effect, by rig, in the units of `foreign.hidden`."""
PAIRS: tuple[tuple[str, str, str], ...] = (
    ("swing", "joint_friction", "actuator_delay"),
    ("swing", "joint_damping", "mass"),
    ("swing", "backlash", "actuator_gain"),
    ("reach", "joint_friction", "gravity_compensation"),
    ("reach", "actuator_delay", "frame_offset"),
    ("gantry", "sliding_friction", "joint_friction"),
    ("gantry", "mass", "actuator_delay"),
    ("launch", "sliding_friction", "length_scale"),
    ("bounce", "air_drag", "contact_compliance"),
    ("roll", "rolling_friction", "gravity_tilt"),
)
"""Rig and two effects at once, both at their large value."""
OUTSIDES: tuple[tuple[str, str, float], ...] = (
    ("swing", "cogging", 0.05),
    ("swing", "warming", 0.06),
    ("swing", "faltering", 0.12),
    ("reach", "cable", 4.0),
    ("reach", "cogging", 0.8),
    ("gantry", "cogging", 4.0),
    ("gantry", "faltering", 6.0),
    ("launch", "magnet", 0.4),
    ("launch", "sticky_spot", 0.6),
    ("roll", "magnet", 0.02),
    ("bounce", "gust", 0.08),
    ("toss", "slosh", 0.3),
)
"""Rig, what the library lacks, and its magnitude in the units of `foreign.outside`."""
DRAKE = ForeignWorld("drake", DRAKE_RIGS, SINGLES, PAIRS, OUTSIDES)


def drake_sets() -> list[DataSet]:
    """Return all data sets, in a fixed order, with names that differ."""
    return DRAKE.sets()


def make_drake(case: DataSet) -> Data:
    """Return the recordings of a data set, the user's scene, and the truth; the same each time."""
    return DRAKE.make(case)


if __name__ == "__main__":
    print_residuals(DRAKE, tyro.cli(Args))
