"""A task with the shapes of its scene in the physics in place of spheres."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from concent_warp.simulate.inputs import compile_model
from concent_warp.train.task.task import Task

CONVEX = (
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID,
)
MAX_HULL_EXCESS = 0.02
"""Share by which the convex hull of a mesh may exceed the mesh in volume: MuJoCo collides hulls."""


def with_nominal_shapes(task: Task) -> Task | None:
    """Return a task whose objects collide as the geoms of the scene do, with the friction and inertia of the model.

    Positions of commands, targets and observations are the same. None where the geoms cannot stand for the objects: an
    object has none that collide, or a mesh with a hollow, which MuJoCo would fill.
    """
    geometry = task.model.geometry
    if geometry is None:
        return None
    m, _ = compile_model(replace(task.model, geometry=None), None)
    for number, name in enumerate(geometry.bodies):
        body = m.body(name)
        geoms = np.arange(body.geomadr[0], body.geomadr[0] + body.geomnum[0])
        geoms = geoms[(m.geom_contype[geoms] != 0) | (m.geom_conaffinity[geoms] != 0)]
        if not len(geoms) or not all(_is_convex(m, int(g)) for g in geoms):
            return None
        m.geom_friction[geoms, 0] = geometry.friction[geometry.body == number].mean()
        for values in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
            getattr(m, values)[body.id] = getattr(task.compiled, values)[body.id]
    mujoco.mj_setConst(m, mujoco.MjData(m))
    return replace(task, compiled=m)


def _is_convex(m: mujoco.MjModel, geom: int) -> bool:
    """Return whether a geom collides as it looks."""
    if mujoco.mjtGeom(m.geom_type[geom]) in CONVEX:
        return True
    if m.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH:
        return False
    import trimesh

    mesh = m.mesh(int(m.geom_dataid[geom]))
    vertices = m.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
    faces = m.mesh_face[mesh.faceadr[0] : mesh.faceadr[0] + mesh.facenum[0]]
    solid = trimesh.Trimesh(vertices, faces)
    return bool(solid.convex_hull.volume <= (1 + MAX_HULL_EXCESS) * abs(solid.volume))
