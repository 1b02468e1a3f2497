"""The objects of a BOP scene as MJCF: each mesh a body with a free joint, in the frame of the camera."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.limits import limits, raising
from concent_warp.recording.logs.bop.dataset import MILLIMETRE, BopInstance
from concent_warp.scene.scene import Scene

if TYPE_CHECKING:
    import trimesh

DENSITY = 1000.0
"""Density of the objects [kg/m^3]: the data sets have no masses."""


def read_mesh(models: Path, number: int) -> trimesh.Trimesh:
    """Return the mesh of an object [m]: vertices at one place merged, holes filled.

    Raises:
        RecordingError: It is missing or cannot be read.
    """
    import trimesh

    path = models / f"obj_{number:06d}.ply"
    if not path.is_file():
        raise RecordingError("the mesh of an object is missing", where=path, fix="unpack all models of the data set")
    if path.stat().st_size > limits().file_bytes:
        raise RecordingError("the mesh is too large", where=path, fix=raising("file_bytes"))
    try:
        loaded = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # trimesh's readers raise whatever their parsers do
        found = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise RecordingError("the mesh of an object cannot be read", where=path, found=found) from None
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces) or not np.isfinite(loaded.vertices).all():
        raise RecordingError("the mesh of an object has no triangles, or vertices that are not finite", where=path)
    # Seams of a texture double vertices; without colours they merge.
    mesh = trimesh.Trimesh(MILLIMETRE * np.asarray(loaded.vertices, float), loaded.faces, process=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    if not mesh.is_watertight:
        mesh.fill_holes()
    if mesh.is_watertight and not mesh.is_winding_consistent:
        trimesh.repair.fix_normals(mesh)
    if not mesh.is_watertight:
        warnings.warn(f"{path}: the mesh is not watertight; its convex hull stands for its surface", stacklevel=2)
    return mesh


def scene_of_objects(instances: Sequence[BopInstance], models: Path) -> Scene:
    """Return a scene of objects whose world is the camera's frame, with sensors of their poses.

    The objects do not collide, and there is no gravity: its direction is not in the data set.

    Raises:
        RecordingError: A mesh is missing or cannot be read.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "bop"
    spec.option.gravity = np.zeros(3)
    for number in sorted({one.object for one in instances}):
        mesh = read_mesh(models, number)
        added = spec.add_mesh(name=f"obj_{number:06d}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
        added.uservert = np.asarray(mesh.vertices, float).ravel()
        added.userface = np.asarray(mesh.faces, int).ravel()
    for one in instances:
        body = spec.worldbody.add_body(name=one.body)
        body.add_freejoint(name=one.body)
        body.add_geom(
            name=one.body, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"obj_{one.object:06d}", density=DENSITY,
            contype=0, conaffinity=0,
        )  # fmt: skip
        for kind, sensor in (
            ("position", mujoco.mjtSensor.mjSENS_FRAMEPOS),
            ("orientation", mujoco.mjtSensor.mjSENS_FRAMEQUAT),
        ):
            spec.add_sensor(name=f"{one.body}_{kind}", type=sensor, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname=one.body)
    return Scene.from_spec(spec, str(models))
