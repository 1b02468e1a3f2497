"""Poses of a robot's bodies over time, from the readings of its joint sensors.

Readings of each joint are smoothed by a cubic least-squares spline whose number of knots is chosen by generalised
cross-validation (Craven and Wahba, "Smoothing noisy data with spline functions", Numerische Mathematik 31, 1979), so
that the noise of single readings does not enter the poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.interpolate import BSpline, make_lsq_spline

from concent_warp.errors import RecordingError
from concent_warp.perception.configuration import Readings, configurations, joint_readings
from concent_warp.recording.recording import Demonstration
from concent_warp.scene.scene import Scene

FEWEST_READINGS = 5
"""Readings that a cubic spline requires."""
READINGS_PER_KNOT = (128, 64, 32, 16, 8, 4, 2)
"""Spacings of knots that are tried [readings]."""
SMALLEST_NOISE = 2e-5
"""Noise of a joint that is taken to be there at least [rad or m]: gears and encoders have a slow error of their own."""


@dataclass(frozen=True)
class JointReadings:
    """Smoothed readings of one joint."""

    spline: BSpline
    """Angle [rad] or travel [m] over time."""
    time: np.ndarray
    """Times of the readings that are there [s], shape (T,)."""
    noise_std: float
    """Standard deviation of the smoothed value [rad or m]."""

    def covers(self, time: np.ndarray, gap: float) -> np.ndarray:
        """Return which times [s] lie between two readings at most `gap` [s] apart, shape of `time`."""
        after = np.searchsorted(self.time, time)
        inside = (after > 0) & (after < len(self.time))
        after = np.clip(after, 1, len(self.time) - 1)
        return inside & (self.time[after] - self.time[after - 1] <= gap)


class JointMotion:
    """Poses of the bodies of a scene along a demonstration."""

    def __init__(self, scene: Scene, demonstration: Demonstration, where: str) -> None:
        """Smooth the readings of all joints that a sensor measures.

        Args:
            scene: The scene of the recording.
            demonstration: What was measured.
            where: File, for messages.

        Raises:
            RecordingError: No joint has readings.
        """
        self.model, self.where = scene.model, f"{where}: {demonstration.name}"
        self.demonstration, self.data = demonstration, mujoco.MjData(self.model)
        self.readings: dict[int, JointReadings] = {}
        for joint, readings in joint_readings(self.model, demonstration).items():
            if (smoothed := _smoothed(readings)) is not None:
                self.readings[joint] = smoothed
        if not self.readings:
            expected = [self.model.sensor(i).name for i in range(self.model.nsensor)][:8]
            raise RecordingError(
                "no joint of the robot has readings, so the poses of its bodies are unknown",
                where=self.where,
                expected=f"channels of jointpos sensors of the scene, such as {expected}",
                found=list(demonstration.measured) or "no measurements",
            )

    @property
    def span(self) -> tuple[float, float]:
        """First and last time at which all joints have readings [s]."""
        times = [r.time for r in self.readings.values()]
        return max(float(t[0]) for t in times), min(float(t[-1]) for t in times)

    def joints(self, *bodies: str) -> list[int]:
        """Return the joints that the poses of some bodies depend on, those that move a body but not others included.

        Raises:
            RecordingError: One of them has no readings, so the body's pose is unknown.
        """
        found: list[int] = []
        for body in bodies:
            row = self.model.body(body).id
            while row:
                address = self.model.body_jntadr[row]
                found += range(address, address + self.model.body_jntnum[row])
                row = self.model.body_parentid[row]
        missing = [self.model.joint(j).name for j in dict.fromkeys(found) if j not in self.readings]
        if missing:
            raise RecordingError(
                f"the pose of body {' or '.join(bodies)} is unknown, since joints on the way to it have no readings",
                where=self.where,
                expected=f"readings of {', '.join(missing)}",
                fix="record a jointpos sensor of each",
            )
        return sorted(set(found))

    def covered(self, joints: Sequence[int], time: np.ndarray, gap: float) -> np.ndarray:
        """Return at which times [s], shape (T,), all joints have readings nearby, shape (T,) bool."""
        covered = np.ones(len(time), dtype=bool)
        for joint in joints:
            covered &= self.readings[joint].covers(time, gap)
        return covered

    def angles(self, time: np.ndarray) -> np.ndarray:
        """Return the generalised positions at times [s], shape (T,), shape (T, nq).

        Joints without readings follow tendons and couplings, see `configurations`; else they rest.
        """
        smoothed = {joint: reading.spline(time) for joint, reading in self.readings.items()}
        return configurations(self.model, self.demonstration, time, smoothed, commanded=False)[0]

    def poses(self, qpos: np.ndarray, body: str) -> np.ndarray:
        """Return the poses of a body at generalised positions (T, nq), shape (T, 4, 4)."""
        row, poses = self.model.body(body).id, np.repeat(np.eye(4)[None], len(qpos), axis=0)
        if row == 0:
            return poses
        for t, state in enumerate(qpos):
            self.data.qpos[:] = state
            mujoco.mj_kinematics(self.model, self.data)
            poses[t, :3, :3] = self.data.xmat[row].reshape(3, 3)
            poses[t, :3, 3] = self.data.xpos[row]
        return poses

    def orientations(self, qpos: np.ndarray) -> np.ndarray:
        """Return the orientations of all bodies at generalised positions (T, nq), shape (T, nbody, 3, 3)."""
        result = np.empty((len(qpos), self.model.nbody, 3, 3))
        for t, state in enumerate(qpos):
            self.data.qpos[:] = state
            mujoco.mj_kinematics(self.model, self.data)
            result[t] = self.data.xmat.reshape(-1, 3, 3)
        return result

    def moving_bodies(self) -> list[str]:
        """Return one body of each group that moves alike, all joints of which have readings; the outermost first."""
        groups: dict[tuple[int, ...], str] = {}
        for row in range(self.model.nbody - 1, 0, -1):
            body = self.model.body(row).name
            try:
                joints = tuple(self.joints(body))
            except RecordingError:
                continue
            if joints and body:
                groups.setdefault(joints, body)  # the outermost of those that move alike
        return list(groups.values())


def _smoothed(readings: Readings) -> JointReadings | None:
    """Return the smoothed readings of a joint, None where there are too few."""
    time, value = readings.time, readings.value
    if len(time) < FEWEST_READINGS:
        return None
    best: tuple[float, BSpline, float] | None = None
    for stride in READINGS_PER_KNOT:
        inner = time[stride:-stride:stride]
        knots = np.concatenate([[time[0]] * 4, inner, [time[-1]] * 4])
        free = len(time) - len(inner) - 4
        if free < 1:
            break
        spline = make_lsq_spline(time, value, knots, k=3)
        squares = float(np.sum((value - spline(time)) ** 2))
        score = len(time) * squares / free**2
        if best is None or score < best[0]:
            best = score, spline, float(np.sqrt(squares / free * (len(inner) + 4) / len(time)))
    assert best is not None
    return JointReadings(best[1], time, max(best[2], SMALLEST_NOISE))
