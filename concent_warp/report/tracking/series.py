"""Series of a track that the page plots: pose, covariance, residuals, agreement."""

from __future__ import annotations

from typing import Any

import numpy as np

from concent_warp.perception.tracking.geometry.pose import rotation_vector
from concent_warp.perception.tracking.result import BodyTrack
from concent_warp.report.scene_data import packed
from concent_warp.report.tracking.spans import quality_of, state_spans

NEAR_FULL_TURN = np.radians(20)
"""Angle from a full turn [rad] within which a rotation vector has no useful covariance: its direction is undetermined
there."""


def track_data(track: BodyTrack) -> dict[str, Any]:
    """Return what the page plots of a track, in mm, degrees, px and percent.

    Positions and orientations are those relative to the first known pose, along the world's axes.
    """
    quality = quality_of(track)
    position, rotation, covariance = relative_motion(track)
    std = np.sqrt(np.maximum(np.einsum("tii->ti", covariance), 0))
    pose_std = np.sqrt(np.einsum("tii->ti", track.covariance))
    columns = {
        **{f"position_{a}": 1e3 * position[:, k] for k, a in enumerate("xyz")},
        **{f"rotation_{a}": np.degrees(rotation[:, k]) for k, a in enumerate("xyz")},
        **{f"position_{a}_band": 2e3 * std[:, k] for k, a in enumerate("xyz")},
        **{f"rotation_{a}_band": 2 * np.degrees(std[:, 3 + k]) for k, a in enumerate("xyz")},
        **{f"position_{a}_2std": 2e3 * pose_std[:, k] for k, a in enumerate("xyz")},
        **{f"rotation_{a}_2std": 2 * np.degrees(pose_std[:, 3 + k]) for k, a in enumerate("xyz")},
        "depth": 1e3 * quality.depth_residual,
        "edge": quality.edge_residual,
        "texture": quality.texture_residual,
        "correlation": 100 * quality.texture_correlation,
        "agreement": 100 * quality.agreement,
        "visible": 100 * quality.visible,
    }
    reasons = list(dict.fromkeys(quality.reason))
    return {
        "name": track.body,
        "sentence": track.sentence(),
        "time": packed(track.time),
        "state": list(quality.state),
        "reasons": reasons,
        "reason": [reasons.index(reason) for reason in quality.reason],
        "spans": [
            {"state": s.state, "start": s.start, "end": s.end, "time": float(track.time[s.first]), "reason": s.reason}
            for s in state_spans(track)
        ],
        **{name: packed(values) for name, values in columns.items() if np.isfinite(values).any()},
    }


def relative_motion(track: BodyTrack) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the motion from the first known pose: positions [m] and rotation vectors [rad], shape (T, 3) each, and
    their covariances, shape (T, 6, 6); all NaN where the pose is.

    A rotation vector is continued beyond half a turn where the one before is nearer to that. Its covariance follows
    from that of a small rotation ``w``, R <- exp(w) R, by the inverse of the left Jacobian of SO(3) (Barfoot, "State
    estimation for robotics", 2017, equation 7.76).
    """
    count = len(track.time)
    position, rotation = np.full((count, 3), np.nan), np.full((count, 3), np.nan)
    covariance = np.array(track.covariance, float)
    known = np.flatnonzero(~track.lost)
    if not len(known):
        return position, rotation, covariance
    start = track.pose[known[0]]
    position[known] = track.pose[known, :3, 3] - start[:3, 3]
    last = np.zeros(3)
    for t in known:
        last = _continued(rotation_vector(track.pose[t, :3, :3] @ start[:3, :3].T), last)
        rotation[t] = last
        jacobian = np.eye(6)
        jacobian[3:, 3:] = _inverse_left_jacobian(last)
        covariance[t] = jacobian @ track.covariance[t] @ jacobian.T
    return position, rotation, covariance


def _continued(vector: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Return that rotation vector [rad] of the same rotation, shape (3,), which is nearest to the one before."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-9:
        return vector
    turns = [vector * (1 + 2 * np.pi * k / angle) for k in (-1, 0, 1)]
    return min(turns, key=lambda turn: float(np.linalg.norm(turn - before)))


def _inverse_left_jacobian(vector: np.ndarray) -> np.ndarray:
    """Return the derivative of a rotation vector [rad] by a small rotation in the world, shape (3, 3)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < 1e-3:
        return np.eye(3) - cross / 2 + cross @ cross / 12
    if angle > np.pi and abs((angle + np.pi) % (2 * np.pi) - np.pi) < NEAR_FULL_TURN:
        return np.full((3, 3), np.nan)
    return np.eye(3) - cross / 2 + (1 / angle**2 - 1 / (2 * angle * np.tan(angle / 2))) * cross @ cross
