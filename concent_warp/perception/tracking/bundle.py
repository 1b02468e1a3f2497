"""What all frames together say about keyframes, and each frame about its pose.

A keyframe's points carry the error of the pose that they were taken at. Depth and edges of all frames that use the
keyframe tell this error: it is the one unknown twist, in the body's frame, that reconciles texture with geometry in
the least-squares sense. Then each frame's normal equations are corrected by it, and what remains unknown of it enters
the covariance as an error that all these frames share, like the errors of depth and edges themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from concent_warp.perception.tracking.alignment.align import Fit
from concent_warp.perception.tracking.alignment.rows import BIASES, bias_stds
from concent_warp.perception.tracking.cfg import AlignCfg
from concent_warp.perception.tracking.smooth import PoseMeasurement

LOOSE = np.diag([1 / 0.01**2] * 3 + [1 / 0.2**2] * 3)
"""Information on the error of a keyframe before anything is measured: 10 mm and 0.2 rad."""


@dataclass(frozen=True)
class Bundle:
    """Measurements of all moments and their common errors."""

    measurements: list[PoseMeasurement | None]
    """One for each moment."""
    common: np.ndarray
    """Change of each pose per standard deviation of errors that do not change from frame to frame, shape (T, 6, E)."""


def bundled(fits: list[Fit | None], keyframes: int, cfg: AlignCfg, turns: Sequence[np.ndarray] = ()) -> Bundle:
    """Return the moments' measurements with the errors of keyframes taken out.

    Args:
        fits: Of each moment; None where the object was not seen.
        keyframes: How many keyframes there are.
        cfg: Settings.
        turns: What is known of the turns of the first keyframes, body frame, shape (3, 3) each [1/rad^2].
    """
    size = 6 * keyframes
    matrix, right = np.kron(np.eye(keyframes), LOOSE), np.zeros(size)
    for k, information in enumerate(turns):
        matrix[6 * k + 3 : 6 * k + 6, 6 * k + 3 : 6 * k + 6] += information
    sensitivity = np.zeros((size, BIASES))
    for fit in fits:
        if fit is None or not fit.texture:
            continue
        turned, inverse, gradient = _turned(fit)
        for k, h_k, g_k in turned:
            rows = slice(6 * k, 6 * k + 6)
            matrix[rows, rows] += h_k
            right[rows] += h_k @ inverse @ gradient - g_k
            sensitivity[rows] += h_k @ inverse @ _in_body(fit) @ fit.geometry.bias
            for other, h_other, _ in turned:
                matrix[rows, 6 * other : 6 * other + 6] -= h_k @ inverse @ h_other
    covariance = np.linalg.inv(matrix) if size else np.zeros((0, 0))
    error, sensitivity = covariance @ right, covariance @ sensitivity
    std = bias_stds(cfg)
    measurements, common = [], np.zeros((len(fits), 6, BIASES + size))
    root = np.linalg.cholesky((covariance + covariance.T) / 2) if size else covariance
    for t, fit in enumerate(fits):
        if fit is None:
            measurements.append(None)
            continue
        body = _in_body(fit)
        information, gradient = fit.geometry.information.copy(), fit.geometry.gradient.copy()
        bias, unknown = fit.geometry.bias.copy(), np.zeros((6, size))
        for k, normal in fit.texture:
            rows = slice(6 * k, 6 * k + 6)
            across = normal.information @ body.T
            information += normal.information
            gradient += normal.gradient + across @ error[rows]
            bias += across @ sensitivity[rows]
            unknown[:, rows] += across
        inverse = np.linalg.inv(information + 1e-3 * LOOSE)
        common[t] = np.hstack([inverse @ bias * std, inverse @ unknown @ root])
        measurements.append(PoseMeasurement(fit.pose, information, gradient))
    return Bundle(measurements, common)


def _in_body(fit: Fit) -> np.ndarray:
    """Return the matrix, shape (6, 6), that turns a twist along the world's axes to one along the body's."""
    return np.kron(np.eye(2), fit.pose[:3, :3].T)


def _turned(fit: Fit) -> tuple[list[tuple[int, np.ndarray, np.ndarray]], np.ndarray, np.ndarray]:
    """Return a moment's texture, inverse of all information and gradient, along the body's axes."""
    body = _in_body(fit)
    texture = [(k, body @ n.information @ body.T, body @ n.gradient) for k, n in fit.texture]
    information = body @ (fit.geometry.information + 1e-3 * LOOSE) @ body.T + sum(h for _, h, _ in texture)
    gradient = body @ fit.geometry.gradient + sum(g for _, _, g in texture)
    return texture, np.linalg.inv(information), gradient
