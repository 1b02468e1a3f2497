"""Effects at the ends of a joint's range: stops that are softer or bouncier than the model's, or elsewhere."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np

from concent_warp.effects.effect import Parameter
from concent_warp.effects.library.joints import MUJOCO, JointEffect
from concent_warp.effects.library.solref import as_time_and_ratio, compliance_parameters, scaled
from concent_warp.effects.select import SINGLE, joints_by_type

USUAL_PLACE = 0.02
"""Typical distance of a stop from where the model has it, relative to the range [-]."""
SCANNED = (-3.0, -1.0, 1.0, 3.0)
"""Places that are tried, in units of the typical distance: where the model's stop is not reached it shows no change."""
FARTHEST = 0.45
"""Farthest place, relative to the range [-]: the two stops stay apart."""


class LimitEffect(JointEffect):
    """An effect at the ends of the range of joints."""

    requirement = "hinges and slides with limits"
    at_limits = True

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:
        """Return whether the joint is a hinge or slide with limits that are damped."""
        return super().applies_to(m, i) and is_stopped(m, i)

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return all such hinges, then all such slides."""
        return joints_by_type(m, [j for j in range(m.njnt) if is_stopped(m, j)], kinds=SINGLE)


class LimitCompliance(LimitEffect):
    """Stops softer, harder or bouncier than the model's."""

    name = "limit_compliance"
    summary = "Time constant and damping ratio of the joint at its limit as a mass on a spring: give and rebound."
    source = f"MuJoCo's solreflimit ({MUJOCO})"
    signature = "rebound from an end stop, and how far it gives way to a load; none elsewhere"
    confusions = ("limit_offset", "joint_damping", "backlash", "actuator_gain")
    null_error = 0.025  # as that of contacts

    def mean(self, m: mujoco.MjModel) -> np.ndarray:
        """Return the mean time constant [s] and damping ratio of the target's limits, shape (2,)."""
        return np.mean([_time_and_ratio(m, int(j)) for j in self.ids(m)], axis=0)

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Time constant and damping ratio; the null values are the means of the joints."""
        time, ratio = map(float, self.mean(m))
        return compliance_parameters(time, ratio, float(m.opt.timestep))

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Reference of the limit's spring."""
        return ("jnt_solref",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set the mean, and all joints in proportion."""
        ids = self.ids(m)
        m.jnt_solref[ids] = scaled(m.jnt_solref[ids], np.asarray(values) / self.mean(m))


class LimitOffset(LimitEffect):
    """Stops elsewhere than in the model."""

    name = "limit_offset"
    summary = "The stops of the joint lie off the model's: its range is from low to high."
    source = f"MuJoCo's range of joints ({MUJOCO})"
    signature = "rest at another end position, however large the command; none elsewhere"
    confusions = ("limit_compliance", "joint_offset", "actuator_saturation", "joint_stiffness")
    exact = True

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return the lower, then the upper end of each joint's range."""
        unit, found = self.units(m, "rad", "m"), []
        for k, end in enumerate(("low", "high")):
            for name, j in zip(self.target, self.ids(m), strict=True):
                place, width = float(m.jnt_range[j, k]), float(np.ptp(m.jnt_range[j]))
                usual, most = USUAL_PLACE * width, FARTHEST * width
                scan = tuple(place + s * usual for s in SCANNED)
                found.append(Parameter(f"{end}[{name}]", unit, place, place - most, place + most, usual, scan=scan))
        return tuple(found)

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Range of the joints."""
        return ("jnt_range",)

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set both ends."""
        m.jnt_range[self.ids(m)] = np.reshape(values, (2, -1)).T


def is_stopped(m: mujoco.MjModel, joint: int) -> bool:
    """Return whether a joint is a hinge or slide with limits that are damped."""
    limited = bool(m.jnt_limited[joint]) and int(m.jnt_type[joint]) in SINGLE
    return limited and bool(np.isfinite(_time_and_ratio(m, joint)).all())


def reached_stops(m: mujoco.MjModel, qpos: Iterable[np.ndarray], margin: float) -> set[str]:
    """Return the names of joints that come near a limit.

    Args:
        m: The compiled model.
        qpos: Courses of the positions, shape (T, nq) each.
        margin: Largest distance from a limit, relative to the range [-].
    """
    stopped = [j for j in range(m.njnt) if is_stopped(m, j)]
    found: set[str] = set()
    for course in qpos:
        for j in stopped:
            low, high = m.jnt_range[j]
            place, near = course[:, m.jnt_qposadr[j]], margin * (high - low)
            if np.min(place) <= low + near or np.max(place) >= high - near:
                found.add(m.joint(j).name)
    return found


def _time_and_ratio(m: mujoco.MjModel, joint: int) -> np.ndarray:
    """Return time constant [s] and damping ratio of a joint's limit, shape (2,)."""
    solref = m.jnt_solref[joint]
    return as_time_and_ratio(solref) if solref[0] <= 0 else np.array(solref)
