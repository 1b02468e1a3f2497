"""First poses of bodies: from a recording's initial state, or from a file that a user wrote."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from concent_warp.documents import is_number, read_json, read_toml
from concent_warp.errors import RecordingError
from concent_warp.perception.tracking.geometry.pose import pose_of
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.recording.recording import Demonstration
from concent_warp.scene.scene import Scene

UNIT_TOLERANCE = 0.05
"""Deviation of a quaternion's norm from 1 that is mended."""


def read_first_poses(path: Path) -> dict[str, np.ndarray]:
    """Return poses, shape (4, 4), by body, from a TOML or JSON file: of each body ``position`` and ``quaternion``
    (wxyz).

    Raises:
        RecordingError: It cannot be read, or something in it is no pose.
    """
    document = read_json(path, RecordingError) if path.suffix == ".json" else read_toml(path, RecordingError)
    if not isinstance(document, dict) or not document:
        raise RecordingError(
            "a file of first poses names no body", where=path, expected="[body] with position, quaternion"
        )
    return {body: _pose(entry, f"{path}, {body}") for body, entry in document.items()}


def _pose(entry: Any, where: str) -> np.ndarray:
    """Return the pose of one entry."""
    values = {}
    for name, count in (("position", 3), ("quaternion", 4)):
        value = entry.get(name) if isinstance(entry, Mapping) else None
        if not isinstance(value, list) or len(value) != count or not all(map(is_number, value)):
            raise RecordingError(f"{name} is not right", where=where, expected=f"{count} numbers", found=value)
        values[name] = np.array(value, float)
    norm = float(np.linalg.norm(values["quaternion"]))
    if abs(norm - 1) > UNIT_TOLERANCE:
        raise RecordingError(
            "the quaternion is not of unit length", where=where, expected="norm 1", found=f"{norm:.3g}"
        )
    return pose_of(values["position"], values["quaternion"])


def is_pose_file(given: object) -> TypeGuard[str | Path]:
    """Return whether first poses are given as a file."""
    return isinstance(given, str | Path) and given not in ("none", "initial")


def first_poses(
    given: str | Path | Mapping[str, np.ndarray],
    scene: Scene,
    demonstration: Demonstration,
    shapes: list[TrackedShape],
    where: str,
) -> dict[str, np.ndarray]:
    """Return the first poses, shape (4, 4), of those bodies that have one.

    Args:
        given: "initial", "none", a file, or poses by body.
        scene: The scene.
        demonstration: Its initial state is taken for "initial", where it has one.
        shapes: The bodies.
        where: For messages.

    Raises:
        RecordingError: The file cannot be read, a body is not tracked, or a pose is no transform.
    """
    if isinstance(given, str) and given == "none":
        return {}
    if isinstance(given, str) and given == "initial":
        if demonstration.qpos is None:
            return {}
        if len(demonstration.qpos) != scene.model.nq:
            raise RecordingError(
                "the initial state is not of this scene",
                where=where,
                expected=f"qpos of {scene.model.nq} numbers",
                found=f"{len(demonstration.qpos)} numbers",
                fix="give the poses in a file, or none",
            )
        renderer = RayRenderer(scene.model)
        renderer.set_state(np.asarray(demonstration.qpos, float))
        return {shape.name: renderer.pose(shape.row) for shape in shapes}
    poses = read_first_poses(Path(given)) if isinstance(given, str | Path) else dict(given)
    names = [shape.name for shape in shapes]
    if unknown := sorted(set(poses) - set(names)):
        raise RecordingError(
            "a first pose of a body that is not tracked", where=where, expected=f"some of {names}", found=unknown
        )
    for body, pose in poses.items():
        pose = np.asarray(pose, float)
        turned = pose[:3, :3] if pose.shape == (4, 4) else np.zeros((3, 3))
        if not np.allclose(turned @ turned.T, np.eye(3), atol=1e-3) or np.linalg.det(turned) < 0:
            raise RecordingError(
                f"the first pose of {body!r} is no transform", where=where, expected="shape (4, 4), a rotation"
            )
    return poses
