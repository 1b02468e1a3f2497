"""How far a replay is from a trial, as one number, and by when it differs.

Errors are in units of their noise; joint errors also of what the trials of the policy's own simulation show, whose
gains and masses vary. Large errors count logarithmically (Cauchy's loss), because after a contact that went another way
they say nothing more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from concent_warp.deploy.explain.replay_trial import ReplayedTrials, TrialReadings, joint_ratio, pose_ratio

LOSS_SCALE = 3.0
"""Error at which the loss turns from quadratic to logarithmic, in units of noise."""


@dataclass(frozen=True)
class Misfit:
    """Errors of N replays of one trial, mean losses of channels; about 1 where only noise is left."""

    joints: np.ndarray
    """Shape (N,)."""
    position: np.ndarray
    """Shape (N,)."""
    orientation: np.ndarray
    """Shape (N,)."""

    @property
    def total(self) -> np.ndarray:
        """Mean of the three, shape (N,)."""
        return (self.joints + self.position + self.orientation) / 3


def misfit(
    readings: TrialReadings, replayed: ReplayedTrials, joint_scale: float, bias: np.ndarray | None = None
) -> Misfit:
    """Return the misfit of replays.

    Args:
        readings: What was measured.
        replayed: N replays.
        joint_scale: Joint errors over their noise that the policy's own simulation shows [-].
        bias: Errors of the tracked poses in each replay: position [m] and rotation vector, shape (N, 6).
    """
    joints = joint_ratio(readings, replayed) / joint_scale
    place, turn = pose_ratio(readings, replayed)
    if bias is not None:
        place = place - bias[:, None, :3] / readings.pose_std[0]
        turn = turn - bias[:, None, 3:] / readings.pose_std[1]
    parts = [np.where(np.isfinite(r), r, 1e3) for r in (joints, place, turn)]
    return Misfit(*(cauchy(r).mean(axis=(1, 2)) for r in parts))


def cauchy(ratio: np.ndarray) -> np.ndarray:
    """Return Cauchy's loss of errors over their noise; the square of small ones."""
    return LOSS_SCALE**2 * np.log1p((ratio / LOSS_SCALE) ** 2)


def divergence(readings: TrialReadings, replayed: ReplayedTrials, joint_scale: float, width: float) -> np.ndarray:
    """Return the RMS error over noise of a replay in each window of a trial, the worse of joints and pose, shape (W,).

    Args:
        readings: What was measured.
        replayed: One replay.
        joint_scale: See `misfit`.
        width: Length of a window [s].
    """
    count = max(1, int(np.ceil(readings.end / width)))
    joints = joint_ratio(readings, replayed)[0] / joint_scale
    place = pose_ratio(readings, replayed)[0][0]
    found = np.zeros(count)
    for time, ratio in ((readings.time, joints), (readings.pose.time, place)):
        window = np.minimum((time / width).astype(int), count - 1)
        for w in range(count):
            if (mine := window == w).any():
                found[w] = max(found[w], float(np.sqrt(np.nanmean(ratio[mine] ** 2))))
    return found
