"""Arrays of numbers of what a user gives for them."""

from __future__ import annotations

from typing import Any

import numpy as np

from concent_warp.errors import RecordingError


def as_array(given: Any, name: str) -> np.ndarray:
    """Return an array of what is given; whole numbers become floating-point numbers, arrays of others stay the same.

    Args:
        given: An array, list, or what NumPy makes an array of.
        name: What it is, for messages.

    Raises:
        RecordingError: It is no array, such as rows of unequal length.
    """
    try:
        array = np.asarray(given)
    except (TypeError, ValueError) as error:
        raise RecordingError(
            f"{name} is not an array", expected="numbers, the same count in each row", found=str(error).split(". ")[0]
        ) from None
    return array.astype(float) if array.dtype.kind in "iu" else array
