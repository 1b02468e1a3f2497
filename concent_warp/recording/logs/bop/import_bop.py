"""A scene of the BOP benchmark as a recording that the tracker reads.

BOP's cameras move in the world, often nobody knows how, and its poses are those of objects in the camera. So the
camera's frame is the world of the recording: the camera stands still, and the objects move before it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.limits import limits, raising
from concent_warp.recording.logs.bop.dataset import BopImage, BopInstance, BopScene, models_folder, read_scene
from concent_warp.recording.logs.bop.meshes import scene_of_objects
from concent_warp.recording.logs.cfg import ImportCfg
from concent_warp.recording.logs.readers.image_files import read_image
from concent_warp.recording.naming import PREFIX
from concent_warp.recording.recording import Channel, Demonstration, ImageStream, Recording
from concent_warp.scene.scene import Scene

CAMERA = "camera"
"""Name of the camera in the recording."""
AWAY = np.array([0.0, 0, -1, 1, 0, 0, 0])
"""Pose, behind the camera [m], of an object that the ground truth does not have in the first image."""
BYTES_PER_PIXEL = 7
"""Memory of colours and depth."""


@dataclass(frozen=True)
class BopImport:
    """A scene before its images are decoded."""

    bop: BopScene
    scene: Scene
    instances: tuple[BopInstance, ...]
    numbers: tuple[int, ...]
    """Images, ascending."""
    size: tuple[int, int]
    """Height and width of the images [px]."""
    demonstration: Demonstration
    """All but the images."""
    cfg: ImportCfg

    @property
    def time(self) -> np.ndarray:
        """Times of the images [s], shape (T,)."""
        return (np.array(self.numbers) - self.numbers[0]) / self.cfg.bop.rate

    def stream(self, rows: Sequence[int], progress: Callable[[float], None] | None = None) -> ImageStream:
        """Decode the images of some rows, ascending.

        Images of a camera whose `cam_K` differs from that of the first are resampled to it: colours linearly, depths
        from the nearest pixel.

        Raises:
            RecordingError: One cannot be decoded, or has another size.
        """
        height, width = self.size
        rgb = np.empty((len(rows), height, width, 3), np.uint8)
        depth = np.empty((len(rows), height, width), np.float32)
        matrix = self.bop.images[self.numbers[0]].intrinsics
        for k, row in enumerate(rows):
            rgb[k], depth[k] = self._decoded(self.bop.images[self.numbers[row]], matrix)
            if progress is not None:
                progress((k + 1) / len(rows))
        return ImageStream(self.time[list(rows)], rgb, depth, matrix, np.eye(4))

    def recording(self, progress: Callable[[float], None] | None = None) -> Recording:
        """Return the recording with all images decoded."""
        image = {CAMERA: self.stream(range(len(self.numbers)), progress)}
        return Recording(self.scene.xml, (replace(self.demonstration, image=image),), str(self.bop.folder))

    def _decoded(self, image: BopImage, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return colours, shape (H, W, 3) uint8, and depths [m], shape (H, W), as a pinhole matrix (3, 3) sees them."""
        color, units = read_image(image.color, depth=False), read_image(image.depth, depth=True)
        for one, path in ((color, image.color), (units, image.depth)):
            if one.shape[:2] != self.size:
                raise RecordingError(
                    "the images differ in their size", where=path, expected=self.size, found=one.shape[:2]
                )
        metres = units.astype(np.float32) * np.float32(image.depth_scale)
        metres = np.where(np.isfinite(metres) & (metres >= self.cfg.depth_from), metres, np.float32(0))
        if np.allclose(image.intrinsics, matrix, atol=1e-6):
            return color, metres
        import cv2

        height, width = self.size
        shift = (matrix @ np.linalg.inv(image.intrinsics))[:2]
        color = cv2.warpAffine(color, shift, (width, height), flags=cv2.INTER_LINEAR)
        return color, cv2.warpAffine(metres, shift, (width, height), flags=cv2.INTER_NEAREST)


def open_bop(folder: Path, cfg: ImportCfg | None = None) -> BopImport:
    """Return a scene of a BOP data set as it is imported, its images not decoded.

    Args:
        folder: Scene, such as ``ycbv/test/000048``.
        cfg: Settings.

    Raises:
        RecordingError: Something of it is missing or not of the format, or the images do not fit in memory.
    """
    cfg = cfg or ImportCfg()
    bop = read_scene(folder)
    numbers = tuple(n for n in bop.images if cfg.bop.first_image <= n <= cfg.bop.last_image)
    if not numbers:
        known = list(bop.images)
        raise RecordingError(
            "no images between the first and the last number", where=bop.folder,
            expected=f"numbers from {known[0]} to {known[-1]}",
            found=f"{cfg.bop.first_image} to {cfg.bop.last_image}",
        )  # fmt: skip
    height, width = read_image(bop.images[numbers[0]].color, depth=False).shape[:2]
    size = len(numbers) * height * width * BYTES_PER_PIXEL
    if size > limits().recording_bytes:
        raise RecordingError(
            "the images are too large", where=bop.folder, found=f"{size:,}",
            expected=f"at most {limits().recording_bytes:,} bytes once decoded",
            fix=f"read fewer with --bop.first-image and --bop.last-image; {raising('recording_bytes')}",
        )  # fmt: skip
    poses = {n: bop.poses[n] for n in numbers if n in bop.poses}
    instances = tuple(one for one in bop.instances() if not poses or any(one in found for found in poses.values()))
    scene = scene_of_objects(instances, models_folder(bop.root, cfg.bop.models))
    name, task = f"{PREFIX}{bop.number}", f"{bop.root.name}, {bop.split}, scene {bop.number}"
    demonstration = Demonstration(name, task)
    if cfg.bop.truth and poses:
        time = {n: (n - numbers[0]) / cfg.bop.rate for n in numbers}
        demonstration = _with_truth(demonstration, scene.model, instances, poses, time)
    return BopImport(bop, scene, instances, numbers, (height, width), demonstration, cfg)


def _with_truth(
    demonstration: Demonstration,
    model: mujoco.MjModel,
    instances: Sequence[BopInstance],
    poses: Mapping[int, Mapping[BopInstance, np.ndarray]],
    time: Mapping[int, float],
) -> Demonstration:
    """Return a demonstration with ground-truth poses as measurements and, if the first image has them, initial state.

    Args:
        demonstration: The demonstration.
        model: The compiled scene.
        instances: The objects.
        poses: Transforms (4, 4) by image and object.
        time: Times of the images [s].
    """
    measured: dict[str, Channel] = {}
    qpos = np.tile(AWAY, len(instances))
    first = next(iter(time))
    for one in instances:
        known = [n for n in poses if one in poses[n]]
        states = np.array([_state(poses[n][one]) for n in known])
        for t in range(1, len(states)):
            states[t, 3:] *= np.sign(states[t, 3:] @ states[t - 1, 3:]) or 1.0
        when = np.array([time[n] for n in known])
        measured[f"{one.body}_position"] = Channel(when, states[:, :3])
        measured[f"{one.body}_orientation"] = Channel(when, states[:, 3:])
        if known[0] == first:
            start = model.joint(one.body).qposadr[0]
            qpos[start : start + 7] = states[0]
    if first not in poses:
        return replace(demonstration, measured=measured)
    return replace(demonstration, measured=measured, qpos=qpos, qvel=np.zeros(model.nv))


def _state(pose: np.ndarray) -> np.ndarray:
    """Return position [m] and quaternion wxyz of a transform (4, 4), shape (7,)."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(pose[:3, :3]).ravel())
    return np.concatenate([pose[:3, 3], quaternion])
