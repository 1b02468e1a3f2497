"""Checks of the frames and the calibration of a camera."""

from __future__ import annotations

import mujoco
import numpy as np

from concent_warp.recording.bounds import MAX_MAGNITUDE
from concent_warp.recording.recording import ImageStream
from concent_warp.recording.validation.cfg import ValidateCfg
from concent_warp.recording.validation.location import ErrorLocation
from concent_warp.recording.validation.magnitudes import check_lengths


def check_image(stream: ImageStream, model: mujoco.MjModel, place: ErrorLocation, cfg: ValidateCfg) -> None:
    """Check frames, depth [m], intrinsics [px] and pose of one camera; its time is checked already.

    Raises:
        RecordingError: With what does not fit.
    """
    shape = np.shape(stream.rgb)
    count = len(stream.time)
    if len(shape) != 4 or shape[0] != count or shape[3] != 3 or 0 in shape or stream.rgb.dtype != np.uint8:
        raise place.error(
            "rgb is not right", expected=f"({count}, H, W, 3) uint8", found=f"{shape} {np.asarray(stream.rgb).dtype}"
        )
    depth = np.asarray(stream.depth)
    if depth.shape != shape[:3] or depth.dtype != np.float32:
        raise place.error("depth is not right", expected=f"{shape[:3]} float32", found=f"{depth.shape} {depth.dtype}")
    for row, frame in enumerate(depth):
        if not np.isfinite(frame).all() or frame.min() < 0:
            raise place.error(
                "a depth is not a distance",
                row=row,
                expected="finite metres, 0 where there is none",
                found=_worst(frame),
            )
    middle = depth[count // 2].ravel()
    check_lengths(middle[middle > 0], model, place, cfg.units)
    _check_intrinsics(stream.intrinsics, shape[2], shape[1], place)
    _check_pose(stream.pose, model, place, cfg)
    names = [model.body(i).name for i in range(model.nbody)]
    if stream.body is not None and stream.body not in names:
        raise place.error("the camera is on a body that the scene lacks", expected=f"one of {names}", found=stream.body)


def _worst(frame: np.ndarray) -> float:
    """Return a value of a depth frame that is not a distance."""
    return float(frame[~(np.isfinite(frame) & (frame >= 0))][0])


def _check_intrinsics(matrix: np.ndarray, width: int, height: int, place: ErrorLocation) -> None:
    """Check a pinhole matrix [px], shape (3, 3), for images of `width` x `height`."""
    matrix = np.asarray(matrix)
    if matrix.shape != (3, 3) or not _usable(matrix):
        raise place.error("intrinsics are not right", expected="(3, 3) finite numbers", found=f"{matrix.shape}")
    focal, centre = np.array([matrix[0, 0], matrix[1, 1]]), np.array([matrix[0, 2], matrix[1, 2]])
    size = np.array([width, height])
    if not np.allclose([matrix[1, 0], *matrix[2]], [0, 0, 0, 1]):
        raise place.error("intrinsics are not a pinhole matrix", expected="[[fx, s, cx], [0, fy, cy], [0, 0, 1]]")
    if (focal <= 0).any() or (focal < size / 100).any() or (focal > size * 1000).any():
        raise place.error("a focal length is not in pixels", expected=f"px, for images of {size}", found=focal)
    if (centre < -size).any() or (centre > 2 * size).any():
        raise place.error("the principal point is far outside the image", expected=f"px within {size}", found=centre)


def _check_pose(pose: np.ndarray, model: mujoco.MjModel, place: ErrorLocation, cfg: ValidateCfg) -> None:
    """Check a camera-to-world transform, shape (4, 4)."""
    pose = np.asarray(pose)
    if pose.shape != (4, 4) or not _usable(pose):
        raise place.error("the camera pose is not right", expected="(4, 4) finite numbers", found=f"{pose.shape}")
    if not np.allclose(pose[3], [0, 0, 0, 1]):
        raise place.error(
            "the camera pose is not a transform",
            row=3,
            expected=[0, 0, 0, 1],
            found=pose[3],
            fix="transpose it if need be",
        )
    rotation = pose[:3, :3].astype(float)
    tolerance = cfg.rotation_tolerance
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > tolerance or np.linalg.det(rotation) < 0:
        raise place.error(
            "the camera pose is not a rotation and a translation",
            expected=f"an orthonormal right-handed matrix within {tolerance}",
            found=f"deviation {error:.3g}, determinant {np.linalg.det(rotation):.3g}",
        )
    check_lengths(np.linalg.norm(pose[None, :3, 3], axis=1), model, place, cfg.units)


def _usable(matrix: np.ndarray) -> bool:
    """Return whether all entries of a matrix are finite numbers and not absurdly large."""
    return matrix.dtype.kind in "fiu" and bool((np.abs(matrix) <= MAX_MAGNITUDE).all())
