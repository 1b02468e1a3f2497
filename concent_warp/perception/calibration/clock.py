"""A first estimate of the offset between the clocks of camera and robot, from speeds of rotation.

The angle by which the target has turned in the camera's view between two frames is that by which one body has turned
against the other, whatever the poses of camera and target on them. So the speeds of rotation of the views are compared
with those that joint readings give at shifted times, over a grid of shifts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from concent_warp.perception.calibration.joint_motion import JointMotion

STEP = 0.005
"""Step of the grid [s]."""
MOST_VIEWS = 100
"""Views of a demonstration that are used."""
SPACINGS = (1, 2, 4)
"""Distances of the frames of a pair, in views."""
MIN_GAIN = 0.8
"""Deviation at the best shift over the median one, above which the shift is unknown [-]."""


class ClockSearch:
    """Speeds of rotation of the views of a target, and of all bodies at shifted times."""

    def __init__(
        self, runs: Sequence[tuple[JointMotion, np.ndarray, np.ndarray]], max_offset: float, *, fixed: bool = False
    ) -> None:
        """Read the orientations of all bodies at all shifts.

        Args:
            runs: Of each demonstration the readings of the joints, times of views [s], shape (n,), increasing, and
                poses of the target in the camera's frame, shape (n, 4, 4).
            max_offset: Largest offset [s].
            fixed: Whether the offset is 0 in any case.
        """
        self.shifts = np.zeros(1) if fixed else np.arange(-max_offset, max_offset + STEP / 2, STEP)
        self._model = runs[0][0].model
        self._runs = []
        for motion, time, seen in runs:
            rows = np.unique(np.linspace(0, len(time) - 1, min(len(time), MOST_VIEWS)).astype(int))
            time, seen = time[rows], seen[rows]
            pairs = [(i, i + k) for k in SPACINGS for i in range(len(time) - k)]
            if not pairs:
                continue
            first, second = np.array(pairs).T
            low, high = motion.span
            moved = np.clip(time + self.shifts[:, None], low, high)
            turned = motion.orientations(motion.angles(moved.ravel())).reshape(*moved.shape, -1, 3, 3)
            lapse = time[second] - time[first]
            self._runs.append((turned, first, second, lapse, _turn(seen[:, :3, :3], first, second) / lapse))

    def offset(self, bodies: tuple[str, str]) -> float:
        """Return the time to be added to times of frames so that they are those of the encoders [s].

        Args:
            bodies: Bodies that carry camera and target.
        """
        one, other = (self._model.body(name).id for name in bodies)
        cost = np.zeros(len(self.shifts))
        for turned, first, second, lapse, viewed in self._runs:
            relative = np.swapaxes(turned[:, :, other], -1, -2) @ turned[:, :, one]
            count = relative.shape[1]
            rows = np.arange(len(self.shifts))[:, None] * count
            flat = relative.reshape(-1, 3, 3)
            speed = _turn(flat, (rows + first).ravel(), (rows + second).ravel()).reshape(len(self.shifts), -1) / lapse
            cost += np.mean(np.abs(speed - viewed), axis=1)
        best = int(np.argmin(cost))
        # Where the arm stands still during all views, every shift is as good, and none is taken.
        return float(self.shifts[best]) if cost[best] < MIN_GAIN * np.median(cost) else 0.0


def _turn(rotations: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the angles between pairs of rotations (n, 3, 3) [rad], shape (pairs,)."""
    # The norm of the difference keeps its precision at small angles.
    distance = np.linalg.norm(rotations[second] - rotations[first], axis=(1, 2))
    return 2 * np.arcsin(np.clip(distance / np.sqrt(8), 0, 1))
