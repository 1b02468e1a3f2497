"""Checks of the covariances of a channel's samples."""

from __future__ import annotations

import numpy as np

from concent_warp.recording.bounds import MAX_MAGNITUDE
from concent_warp.recording.validation.location import ErrorLocation

ROUNDING = 1e-6
"""Error of symmetry and sign that rounding explains, over the largest variance of the sample [-]."""


def check_covariance(covariance: np.ndarray, value: np.ndarray, dimension: int, place: ErrorLocation) -> None:
    """Check that each sample has a covariance matrix, NaN only where its value is missing.

    Args:
        covariance: Shape (T, k, k).
        value: Values, shape (T, dim).
        dimension: k, that of the value's error.
        place: For messages.

    Raises:
        RecordingError: With the first thing that is wrong.
    """
    matrix, shape = np.asarray(covariance), (len(value), dimension, dimension)
    if matrix.shape != shape or matrix.dtype.kind not in "fiu":
        fix = "write one matrix per time; that of a quaternion is of its rotation vector, 3 by 3"
        raise place.error("wrong shape of covariance", expected=shape, found=f"{matrix.shape} {matrix.dtype}", fix=fix)
    given = np.asarray(np.isfinite(np.asarray(value, float)).all(axis=1))
    known = np.asarray(np.isfinite(matrix).all(axis=(1, 2)))
    huge = np.asarray((np.abs(matrix) > MAX_MAGNITUDE).any(axis=(1, 2)))
    _refuse(
        np.asarray(given & ~known), place, "a covariance is missing", "finite numbers where there is a value", matrix
    )
    _refuse(huge, place, "a covariance is absurdly large", "SI units", matrix)
    filled = np.where(known[:, None, None], matrix, 0.0)
    slack = ROUNDING * np.abs(filled).max(axis=(1, 2), initial=0.0)
    skew = np.abs(filled - np.swapaxes(filled, 1, 2)).max(axis=(1, 2), initial=0.0)
    _refuse(np.asarray(skew > slack), place, "a covariance is not symmetric", "a symmetric matrix", matrix)
    least = np.linalg.eigvalsh(filled)[:, 0]
    _refuse(
        np.asarray(least < -slack), place, "a covariance has a negative variance", "variances of at least 0", matrix
    )


def check_common(common: np.ndarray, covariance: np.ndarray | None, value: np.ndarray, place: ErrorLocation) -> None:
    """Check that what samples have in common is a part of their covariances.

    Args:
        common: Shape (T, k, m).
        covariance: Shape (T, k, k), checked; None where there is none.
        value: Values, shape (T, dim).
        place: For messages.

    Raises:
        RecordingError: With the first thing that is wrong.
    """
    matrix = np.asarray(common)
    if covariance is None:
        raise place.error("errors in common without a covariance", fix="write the covariances that they are a part of")
    size = np.asarray(covariance).shape[:2]
    if matrix.ndim != 3 or matrix.shape[:2] != size or matrix.dtype.kind not in "fiu":
        expected = f"({size[0]}, {size[1]}, number of errors)"
        raise place.error("wrong shape of common", expected=expected, found=f"{matrix.shape} {matrix.dtype}")
    given = np.asarray(np.isfinite(np.asarray(value, float)).all(axis=1))
    known = np.asarray(np.isfinite(matrix).all(axis=(1, 2)))
    what = "an error in common is missing"
    _refuse(np.asarray(given & ~known), place, what, "finite numbers where there is a value", matrix)
    rows = np.flatnonzero(given)
    own, alone = np.asarray(covariance, float)[rows], np.asarray(matrix, float)[rows]
    bad = np.zeros(len(value), dtype=bool)
    if len(rows):
        least = np.linalg.eigvalsh(own - alone @ np.swapaxes(alone, 1, 2))[:, 0]
        bad[rows] = least < -ROUNDING * np.abs(own).max(axis=(1, 2))
    what = "errors in common exceed the covariance"
    _refuse(bad, place, what, "common times its transpose is a part of the covariance", matrix)


def _refuse(bad: np.ndarray, place: ErrorLocation, what: str, expected: str, matrix: np.ndarray) -> None:
    """Raise an error for the first sample, if any, that is bad, shape (T,) bool."""
    if bad.any():
        row = int(bad.argmax())
        found = np.array2string(matrix[row].ravel(), precision=3, threshold=9, max_line_width=200)
        raise place.error(what, row=row, expected=expected, found=found)
