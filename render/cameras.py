"""Calibrated cameras: of a recording, of a scene, and of trained networks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.errors import RenderError
from concent_warp.recording.logs.readers.calibration import Calibration
from concent_warp.recording.recording import ImageStream
from concent_warp.scene.scene import Scene

PINHOLE_TOLERANCE = 0.02
"""Largest offset of the principal point from the centre, as a share of the image, and largest relative difference of
the focal lengths, that are neglected [-]: the renderer has neither."""


@dataclass(frozen=True)
class Camera:
    """A camera without distortion and with a centred principal point."""

    name: str
    body: str | None
    """Body that carries it; None if it is fixed in the world."""
    position: tuple[float, float, float]
    """Position [m] in the frame of the body or the world, shape (3,)."""
    quaternion: tuple[float, float, float, float]
    """Orientation wxyz in that frame; the camera looks along -z with y up, as in MuJoCo."""
    fovy: float
    """Vertical field of view [degrees]."""

    @property
    def moves(self) -> bool:
        """Whether a body carries it."""
        return self.body is not None

    @staticmethod
    def of(name: str, stream: ImageStream) -> Camera:
        """Return the camera that took a stream.

        Raises:
            RenderError: Its principal point is not in the middle, or its pixels are not square.
        """
        height, width = stream.rgb.shape[1:3]
        matrix = np.asarray(stream.intrinsics, float)
        off = np.abs(matrix[:2, 2] - [(width - 1) / 2, (height - 1) / 2]) / [width, height]
        if off.max() > PINHOLE_TOLERANCE or abs(matrix[0, 0] / matrix[1, 1] - 1) > PINHOLE_TOLERANCE:
            raise RenderError(
                "images of this camera cannot be rendered",
                where=name,
                expected="square pixels and the principal point in the middle of the image",
                found=matrix.round(1).tolist(),
                fix="crop and rectify the images",
            )
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, (np.asarray(stream.pose)[:3, :3] @ np.diag([1.0, -1.0, -1.0])).ravel())
        x, y, z = (float(v) for v in np.asarray(stream.pose)[:3, 3])
        w, i, j, k = (float(v) for v in quaternion)
        return Camera(
            name, stream.body, (x, y, z), (w, i, j, k), float(2 * np.degrees(np.arctan(height / 2 / matrix[1, 1])))
        )

    @staticmethod
    def in_scene(scene: Scene, name: str) -> Camera:
        """Return a camera of a scene.

        Raises:
            RenderError: It has none of the name.
        """
        m = scene.model
        row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_CAMERA, name)
        if row < 0:
            found = [m.camera(i).name for i in range(m.ncam)]
            raise RenderError(
                "the scene has no such camera", where=scene.source, expected=f"one of {found}", found=name
            )
        body = None if m.cam_bodyid[row] == 0 else m.body(m.cam_bodyid[row]).name
        x, y, z = (float(v) for v in m.cam_pos[row])
        w, i, j, k = (float(v) for v in m.cam_quat[row])
        return Camera(name, body, (x, y, z), (w, i, j, k), float(m.cam_fovy[row]))


def place_cameras(spec: mujoco.MjSpec, cameras: Sequence[Camera]) -> None:
    """Add cameras to a spec; they replace those of the same names.

    Raises:
        RenderError: A camera's body is not there.
    """
    for camera in cameras:
        for there in list(spec.cameras):
            if there.name == camera.name:
                spec.delete(there)
        body = spec.worldbody if camera.body is None else spec.body(camera.body)
        if body is None:
            raise RenderError(
                "the body that carries a camera is not in the scene", where=camera.name, found=camera.body
            )
        body.add_camera(name=camera.name, pos=list(camera.position), quat=list(camera.quaternion), fovy=camera.fovy)


def scene_calibration(model: mujoco.MjModel, name: str, size: tuple[int, int]) -> Calibration:
    """Return the calibration of a camera of a compiled scene for images of a size (height, width) [px]."""
    row = model.camera(name).id
    height, width = size
    focal = height / 2 / np.tan(np.radians(model.cam_fovy[row]) / 2)
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    pose, rotation = np.eye(4), np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.cam_quat[row])
    # MuJoCo's cameras look along -z and have y up.
    pose[:3, :3] = rotation.reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = model.cam_pos[row]
    body = None if model.cam_bodyid[row] == 0 else model.body(int(model.cam_bodyid[row])).name
    return Calibration(matrix, np.zeros(0), pose, body, size)
