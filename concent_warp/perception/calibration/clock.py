"""A first estimate of the offset between the clocks of camera and robot, from speeds of rotation.

The angle by which the target has turned in the camera's view between two frames is that by which one body has turned
against the other, whatever the poses of camera and target on them. So the speeds of rotation of the views are compared
with those that joint readings give at shifted times, over a grid of shifts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from concent_warp.perception.calibration.joint_motion import JointMotion

STEP = 0.005
"""Step of the grid [s]."""
SPACINGS = (1, 2, 4)
"""Distances of the frames of a pair, in views."""
MIN_GAIN = 0.8
"""Deviation at the best shift over the median one, above which the shift is unknown [-]."""


def clock_offset(
    runs: Sequence[tuple[JointMotion, np.ndarray, np.ndarray]], bodies: tuple[str, str], max_offset: float
) -> float:
    """Return the time to be added to the times of frames so that they are those of the encoders [s].

    Args:
        runs: Of each demonstration the readings of the joints, times of views [s], shape (n,), increasing, and poses of
            the target in the camera's frame, shape (n, 4, 4).
        bodies: Bodies that carry camera and target.
        max_offset: Largest offset [s].
    """
    shifts = np.arange(-max_offset, max_offset + STEP / 2, STEP)
    cost = sum(_deviation(*run, bodies, shifts) for run in runs)
    best = int(np.argmin(cost))
    # Where the arm stands still during all views, every shift is as good, and none is taken.
    return float(shifts[best]) if cost[best] < MIN_GAIN * np.median(cost) else 0.0


def _deviation(
    motion: JointMotion, time: np.ndarray, seen: np.ndarray, bodies: tuple[str, str], shifts: np.ndarray
) -> np.ndarray:
    """Return the mean absolute deviation of the speeds [rad/s] at shifts [s], shape (s,)."""
    low, high = motion.span
    pairs = [(i, i + k) for k in SPACINGS for i in range(len(time) - k)]
    if not pairs:
        return np.zeros(len(shifts))
    first, second = np.array(pairs).T
    lapse = time[second] - time[first]
    viewed = _turn(seen[:, :3, :3], first, second) / lapse
    cost = np.zeros(len(shifts))
    for s, shift in enumerate(shifts):
        qpos = motion.angles(np.clip(time + shift, low, high))
        relative = np.linalg.inv(motion.poses(qpos, bodies[1])) @ motion.poses(qpos, bodies[0])
        cost[s] = float(np.mean(np.abs(_turn(relative[:, :3, :3], first, second) / lapse - viewed)))
    return cost


def _turn(rotations: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the angles between pairs of rotations (n, 3, 3) [rad], shape (pairs,)."""
    return Rotation.from_matrix(np.swapaxes(rotations[second], 1, 2) @ rotations[first]).magnitude()
