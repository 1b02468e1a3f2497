"""Cameras of a scene: those that a user's MJCF has, else a base camera beside the objects and one on the wrist."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from concent_warp.errors import SceneError
from concent_warp.scene.scene import Scene

BASE, WRIST = "base", "wrist"
"""Names of the two cameras of the paper's set-up."""
BASE_OFFSET = (0.86, -0.5, 0.52)
"""Position of the base camera relative to the centre of the objects [m]."""
BASE_TARGET = (-0.02, 0.0, 0.13)
"""Point that the base camera looks at, relative to the same centre [m]."""
BASE_FOVY = 42.0
"""Vertical field of view of the base camera [degrees]."""
WRIST_OFFSET = (0.08, 0.0, -0.05)
"""Position of the wrist camera in the frame of the tool site [m]; the tool points along z."""
WRIST_TARGET = (0.012, 0.0, 0.06)
"""Point that the wrist camera looks at, in the same frame [m]."""
WRIST_FOVY = 75.0
"""Vertical field of view of the wrist camera [degrees]."""


def add_cameras(spec: mujoco.MjSpec, objects: Sequence[str], *, tool_site: str = "tcp") -> tuple[str, ...]:
    """Add the missing ones of base and wrist camera to a spec, and return the names of all its cameras.

    The base camera requires objects, the wrist camera the tool site.

    Args:
        spec: The scene; it is changed.
        objects: Names of the bodies that the base camera looks at.
        tool_site: Site between the fingertips, its z axis along the fingers.
    """
    there = [camera.name for camera in spec.cameras]
    if BASE not in there and objects:
        compiled = spec.copy().compile()
        data = mujoco.MjData(compiled)
        mujoco.mj_kinematics(compiled, data)
        middle = np.mean([data.body(name).xpos for name in objects], axis=0)
        place = middle + np.array(BASE_OFFSET)
        add_camera(spec.worldbody, BASE, place, middle + np.array(BASE_TARGET), (0, 0, 1), BASE_FOVY)
    site = spec.site(tool_site)
    if WRIST not in there and site is not None:
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, np.array(site.quat))
        turned = rotation.reshape(3, 3)
        place, target = (np.array(site.pos) + turned @ np.array(p) for p in (WRIST_OFFSET, WRIST_TARGET))
        add_camera(site.parent, WRIST, place, target, turned @ np.array([1.0, 0, 0]), WRIST_FOVY)
    return tuple(camera.name for camera in spec.cameras)


def add_camera(
    body: mujoco.MjsBody,
    name: str,
    position: Sequence[float] | np.ndarray,
    target: Sequence[float] | np.ndarray,
    up: Sequence[float] | np.ndarray,
    fovy: float,
) -> None:
    """Add a camera to a body that looks at a point of the body's frame.

    Args:
        body: Body that the camera is fixed to.
        name: Its name.
        position: Position [m], body frame.
        target: Point that the camera looks at [m], body frame.
        up: Direction that is upwards in the image, body frame.
        fovy: Vertical field of view [degrees].
    """
    back = np.asarray(position, float) - np.asarray(target, float)
    back /= np.linalg.norm(back)
    right = np.cross(np.asarray(up, float), back)
    right /= np.linalg.norm(right)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.stack([right, np.cross(back, right), back], axis=1).ravel())
    body.add_camera(name=name, pos=list(position), quat=list(quaternion), fovy=fovy)


def with_cameras(scene: Scene, names: Sequence[str], *, tool_site: str = "tcp") -> Scene:
    """Return a scene that has cameras of these names: the scene itself where it does, else with what can be added.

    Raises:
        SceneError: The scene has no camera of a name, and it is not one that can be added.
    """
    spec = scene.spec()
    have = [camera.name for camera in spec.cameras]
    if set(names) <= set(have):
        return scene
    have = add_cameras(spec, scene.objects(), tool_site=tool_site)
    if missing := [name for name in names if name not in have]:
        raise SceneError(
            "the scene has no such camera",
            where=scene.source,
            expected=f"some of {sorted(have)}",
            found=missing,
            fix="add a <camera> of that name to the MJCF or choose others",
        )
    return Scene.from_spec(spec, scene.source)
