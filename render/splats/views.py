"""Posed images of an object, in the ``transforms.json`` format of NeRF data sets.

A folder has ``transforms.json`` and images. The file has, at the top or in each frame, the pinhole camera: ``fl_x``,
``fl_y``, ``cx``, ``cy`` [px], or ``camera_angle_x``, the horizontal field of view [rad]; and ``frames``, each with
``file_path`` and ``transform_matrix``, the camera-to-world matrix [m] of a camera that looks along -z with y up
(OpenGL, Blender and MuJoCo). Images are RGBA, alpha the mask of the object, or RGB.

Two things are ours: pixel coordinates in the file count from the image's corner, as is usual there, while here (0, 0)
is the centre of the first pixel; and an optional ``object_pose``, position [m] and quaternion wxyz of the object in the
world, after which the splats are in the frame of the object.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.documents import read_json
from concent_warp.errors import RenderError
from concent_warp.files import write_text

FILE = "transforms.json"
SUFFIXES = (".png", ".jpg", ".jpeg")
"""Tried in turn where a ``file_path`` has no suffix."""


@dataclass(frozen=True)
class SplatViews:
    """V images of one size and where their cameras were, in the frame of the object."""

    rgba: np.ndarray
    """Colours and mask, not premultiplied, uint8, shape (V, H, W, 4)."""
    poses: np.ndarray
    """Camera-to-object transforms of cameras that look along -z, y up, shape (V, 4, 4)."""
    intrinsics: np.ndarray
    """Pinhole matrices [px], (0, 0) the centre of the first pixel, shape (V, 3, 3)."""
    masked: bool
    """Whether alpha separates the object from the background."""
    known: np.ndarray | None = None
    """Whether a pixel tells anything of the object, bool, shape (V, H, W): what hides it does not. All by default;
    files have no place for it."""

    def __len__(self) -> int:
        return len(self.rgba)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.rgba.shape[2], self.rgba.shape[1]

    def camera_poses(self) -> np.ndarray:
        """Return positions [m] and quaternions wxyz of the cameras, shape (V, 7)."""
        from scipy.spatial.transform import Rotation

        quaternions = Rotation.from_matrix(self.poses[:, :3, :3]).as_quat(scalar_first=True)
        return np.concatenate([self.poses[:, :3, 3], quaternions], axis=1)

    def shrunk(self, longest: int) -> SplatViews:
        """Return the views with images whose longer edge is at most so many pixels."""
        import cv2

        width, height = self.size
        if max(width, height) <= longest:
            return self
        size = [max(1, round(edge * longest / max(width, height))) for edge in (width, height)]
        rgba = np.empty((len(self), size[1], size[0], 4), np.uint8)
        for v, image in enumerate(self.rgba):
            # Colours weigh by how much of a pixel they cover.
            covering = image.astype(np.float32)
            covering[..., :3] *= covering[..., 3:] / 255
            small = cv2.resize(covering, size, interpolation=cv2.INTER_AREA)
            small[..., :3] /= np.maximum(small[..., 3:] / 255, 1e-3)
            rgba[v] = np.round(np.clip(small, 0, 255))
        intrinsics = self.intrinsics.copy()
        for k, (new, old) in enumerate(zip(size, (width, height), strict=True)):
            intrinsics[:, k] *= new / old
            intrinsics[:, k, 2] += 0.5 * new / old - 0.5
        known = self.known
        if known is not None:
            # A pixel is known where all that it is made of is.
            share = [cv2.resize(one.astype(np.float32), size, interpolation=cv2.INTER_AREA) for one in known]
            known = np.array(share) > 0.999
        return SplatViews(rgba, self.poses, intrinsics, self.masked, known)

    def write(self, folder: Path) -> None:
        """Write the images as PNG and the file that lists them; this comes last."""
        import cv2

        folder.mkdir(parents=True, exist_ok=True)
        frames = []
        for v, image in enumerate(self.rgba):
            name = f"{v:04d}.png"
            cv2.imwrite(str(folder / name), image[..., [2, 1, 0, 3]] if self.masked else image[..., 2::-1])
            matrix = self.intrinsics[v]
            frames.append(
                {
                    "file_path": name,
                    "transform_matrix": self.poses[v].tolist(),
                    **{"fl_x": matrix[0, 0], "fl_y": matrix[1, 1], "cx": matrix[0, 2] + 0.5, "cy": matrix[1, 2] + 0.5},
                }
            )
        write_text(folder / FILE, json.dumps({"w": self.size[0], "h": self.size[1], "frames": frames}, indent=1))


def read_views(path: Path) -> SplatViews:
    """Read posed images from a folder with a ``transforms.json``, or from such a file.

    Raises:
        RenderError: the file or an image is missing or broken, poses are no poses, or images differ in size.
    """
    path = Path(path)
    file = path / FILE if path.is_dir() else path
    if not file.is_file():
        found = "something else than a file" if file.exists() else "No such file or directory"
        raise RenderError("no posed images", where=file, expected=FILE, found=found)
    document = read_json(file, RenderError)
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise RenderError("no list of frames", where=file, expected="frames, each with file_path and transform_matrix")
    to_object = np.linalg.inv(_object_frame(document.get("object_pose"), file))
    images, poses, intrinsics, masked = [], [], [], []
    for k, frame in enumerate(frames):
        where = f"{file}, frame {k}"
        image, has_alpha = _read_image(file.parent, frame, where)
        if images and image.shape != images[0].shape:
            raise RenderError("images differ in size", where=where, expected=images[0].shape[:2], found=image.shape[:2])
        images.append(image)
        masked.append(has_alpha)
        poses.append(to_object @ _camera_frame(frame.get("transform_matrix"), where))
        intrinsics.append(_pinhole({**document, **frame}, image.shape[1], image.shape[0], where))
    return SplatViews(np.stack(images), np.stack(poses), np.stack(intrinsics), all(masked))


def _read_image(folder: Path, frame: dict[str, Any], where: str) -> tuple[np.ndarray, bool]:
    """Return an image as RGBA (H, W, 4), uint8, and whether it has a mask."""
    import cv2

    name = str(frame.get("file_path", ""))
    tried = [folder / (name + suffix) for suffix in ("", *SUFFIXES)]
    found = next((path for path in tried if path.is_file()), None)
    if found is None:
        raise RenderError("no such image", where=where, found=repr(name), fix="check file_path")
    image = cv2.imread(str(found), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (3, 4):
        raise RenderError("not an image of 8-bit colours", where=found, expected="RGB or RGBA, as PNG or JPEG")
    alpha = image[..., 3] if image.shape[2] == 4 else np.full(image.shape[:2], 255, np.uint8)
    return np.dstack([image[..., 2::-1], alpha]), image.shape[2] == 4


def _camera_frame(value: Any, where: str) -> np.ndarray:
    """Return a camera-to-world matrix, shape (4, 4), rotation of unit scale."""
    try:
        matrix = np.array(value, dtype=float)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise RenderError("transform_matrix is no camera pose", where=where, expected="4 rows of 4 numbers")
    rotation = matrix[:3, :3]
    off = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if off > 1e-3 or np.linalg.det(rotation) < 0:
        raise RenderError(
            "transform_matrix is no rotation and translation", where=where, expected="a rotation of determinant 1",
            found=f"determinant {np.linalg.det(rotation):.4g}, {off:.2g} from a rotation",
        )  # fmt: skip
    return np.vstack([matrix[:3], [0, 0, 0, 1]])


def _object_frame(value: Any, where: Path) -> np.ndarray:
    """Return the pose of the object as a matrix, shape (4, 4); the world's frame where none is given."""
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    if value is None:
        return matrix
    try:
        numbers = np.array(value, dtype=float)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (7,) or not np.isfinite(numbers).all() or not numbers[3:].any():
        raise RenderError("object_pose is no pose", where=where, expected="x, y, z, and a quaternion w, x, y, z")
    matrix[:3, :3] = Rotation.from_quat(numbers[3:], scalar_first=True).as_matrix()
    matrix[:3, 3] = numbers[:3]
    return matrix


def _pinhole(values: dict[str, Any], width: int, height: int, where: str) -> np.ndarray:
    """Return the pinhole matrix [px], shape (3, 3), of a frame, given for images of the size ``w`` x ``h``."""
    try:
        shrink_x = width / float(values.get("w", width))
        shrink_y = height / float(values.get("h", height))
        if "fl_x" in values:
            focal_x = shrink_x * float(values["fl_x"])
        else:
            focal_x = width / 2 / math.tan(float(values["camera_angle_x"]) / 2)
        focal_y = shrink_y * float(values["fl_y"]) if "fl_y" in values else focal_x
        centre = [shrink_x * float(values.get("cx", width / shrink_x / 2)) - 0.5]
        centre.append(shrink_y * float(values.get("cy", height / shrink_y / 2)) - 0.5)
    except KeyError:
        raise RenderError(
            "the camera's focal length is missing", where=where, expected="fl_x or camera_angle_x"
        ) from None
    except (TypeError, ValueError, ZeroDivisionError) as error:
        raise RenderError("the camera cannot be read", where=where, found=error) from None
    matrix = np.array([[focal_x, 0, centre[0]], [0, focal_y, centre[1]], [0, 0, 1]])
    if not (np.isfinite(matrix).all() and focal_x > 0 and focal_y > 0):
        raise RenderError("the camera is none", where=where, expected="focal lengths > 0", found=(focal_x, focal_y))
    return matrix
