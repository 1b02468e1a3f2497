"""Images in files: colours and depths, decoded by OpenCV."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from concent_warp.errors import RecordingError

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
"""Kinds of files."""


def read_image(path: Path, *, depth: bool) -> np.ndarray:
    """Return an image: colours (H, W, 3) uint8, or depths (H, W) uint16 or float32 as they are stored.

    Raises:
        RecordingError: It cannot be decoded, or is not of this kind.
    """
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise RecordingError("an image cannot be decoded", where=path, expected="PNG or JPEG")
    if depth:
        if image.ndim != 2 or image.dtype not in (np.uint16, np.float32):
            raise RecordingError(
                "an image of depths is not one", where=path, expected="one channel of 16 bits",
                found=f"{image.shape} {image.dtype}", fix="export depths raw, not as a picture in colours",
            )  # fmt: skip
        return image
    if image.dtype != np.uint8:
        raise RecordingError("an image of colours has not 8 bits a channel", where=path, found=str(image.dtype))
    return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB)
