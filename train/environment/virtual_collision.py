"""Virtual collision penalty of spheres outside the physics near other bodies (paper, section 3.2.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.errors import SceneError
from concent_warp.kernels.virtual_collision import SphereSet, TargetMesh, VirtualCollision, VirtualPair
from concent_warp.scene.shapes.surface import Surface
from concent_warp.scene.spheres.inset import inset
from concent_warp.scene.spheres.sampling import farthest_point_sampling
from concent_warp.train.cfg import CollisionCfg
from concent_warp.train.environment.physics import Physics
from concent_warp.train.task.task import Task

if TYPE_CHECKING:
    import trimesh


def virtual_collision(task: Task, physics: Physics, stage: object, cfg: CollisionCfg) -> VirtualCollision | None:
    """Return the virtual collision penalty of a task, None without spheres or points to penalise.

    Spheres of an object outside the physics are penalised near the surfaces of the other objects and of the robot's
    links, and points of its surface inside the other objects: spheres round off edges, so that an object that slides
    over such an edge in the simulation would catch on a sharp one. An object without a surface has neither, and must
    have all its spheres in the physics. The margin band does not apply to bodies that touch in the target event.

    Args:
        task: The task.
        physics: The worlds.
        stage: Stage of each world, int32 Warp array, shape (N,).
        cfg: Margins and weights.
    """
    geometry, m = task.model.geometry, task.compiled
    assert geometry is not None
    sets, points = [], []
    stages = task.table.used.shape[0]
    for body in geometry.bodies:
        left = geometry.of(body)[~task.collidable[geometry.of(body)]]
        try:
            surface = Surface.of_body(task.model.scene, body)
        except SceneError:
            if len(left):
                raise
            continue  # all its spheres are in the physics
        if cfg.points:
            points.append(SphereSet(m.body(body).id, _surface_points(surface, cfg), np.zeros(cfg.points)))
        if len(left):
            covered = _within(surface, geometry.position[left], geometry.radius[left], cfg.slack)
            sets.append(SphereSet(m.body(body).id, *covered))
    links = {int(i) for i in m.jnt_bodyid[task.robot.joint]}
    tool = int(m.site_bodyid[task.robot.tool])
    for i in range(m.nbody):  # parents come before their children
        if i == tool or int(m.body_parentid[i]) in links:
            links.add(i)
    scene = task.model.scene.model
    targets: list[SphereSet | TargetMesh] = []
    for body in (*task.objects, *sorted(links - set(task.objects))):
        mesh = _body_mesh(scene, body, visual=body in task.objects)
        if mesh is not None:
            targets.append(TargetMesh(body, *mesh))
    reaches = {0: range(len(targets)), 1: [j for j, b in enumerate(targets) if b.body in task.objects]}
    pairs = [
        VirtualPair(i, j, cfg.margin, cfg.severe, tuple(_gate(task, s, a.body, targets[j].body) for s in range(stages)))
        for i, a in enumerate([*sets, *points])
        for j in reaches[i >= len(sets)]
        if a.body != targets[j].body
    ]
    if not pairs:
        return None
    return VirtualCollision(
        [*sets, *points],
        targets,
        pairs,
        *physics.poses(),
        stage,  # pyright: ignore[reportArgumentType]
        stages=stages,
        depth_weight=cfg.depth,
        band_weight=cfg.band,
        severe_penalty=0.0,
        threads=cfg.threads,
    )


def _within(surface: Surface, centre: np.ndarray, radius: np.ndarray, slack: float) -> tuple[np.ndarray, np.ndarray]:
    """Return spheres moved `slack` [m] below an object's surface: centres [m], shape (n, 3), radii [m], shape (n,).

    A fit moves only spheres that were in contact below the surface. Others protrude by up to their radius and would
    penalise the demonstrated motion in narrow gaps.
    """
    distance, outward = surface.distance(centre)
    deep = np.clip(-distance, 0.0, radius)
    inward = np.maximum(distance + np.maximum(deep, slack), 0.0)
    return centre - inward[:, None] * outward, np.maximum(deep - slack, 0.0)


def _surface_points(surface: Surface, cfg: CollisionCfg) -> np.ndarray:
    """Return points distributed over an object's surface, the slack below it [m], shape (cfg.points, 3)."""
    found, _ = surface.sample(max(cfg.candidates, cfg.points), np.random.default_rng(0))
    return inset(surface, found[farthest_point_sampling(found, cfg.points)], cfg.slack)[0]


def _gate(task: Task, stage: int, a: int, b: int) -> float:
    """Return 0 if two bodies touch in a stage's target event, else 1."""
    used = task.table.used[stage]
    touching = set(zip(task.table.body_a[stage][used], task.table.body_b[stage][used], strict=True))
    return 0.0 if touching & {(a, b), (b, a)} else 1.0


def _body_mesh(m: mujoco.MjModel, body: int, *, visual: bool) -> tuple[np.ndarray, np.ndarray] | None:
    """Return vertices [m] (v, 3) and faces (f, 3) of a body's shapes, body frame; None without shapes.

    `visual` takes all shapes, otherwise only those that collide.
    """
    parts = []
    for g in range(m.body_geomadr[body], m.body_geomadr[body] + m.body_geomnum[body]):
        if not visual and not (m.geom_contype[g] or m.geom_conaffinity[g]):
            continue
        shape = _geom_mesh(m, g)
        if shape is not None:
            rotation = np.empty(9)
            mujoco.mju_quat2Mat(rotation, m.geom_quat[g])
            parts.append((shape.vertices @ rotation.reshape(3, 3).T + m.geom_pos[g], shape.faces))
    if not parts:
        return None
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [faces + start for (_, faces), start in zip(parts, first, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def _geom_mesh(m: mujoco.MjModel, geom: int) -> trimesh.Trimesh | None:
    """Return a geom's mesh in its own frame, None for planes and height fields."""
    import trimesh

    kinds, size = mujoco.mjtGeom, m.geom_size[geom]
    kind = kinds(m.geom_type[geom])
    if kind == kinds.mjGEOM_BOX:
        return trimesh.creation.box(2 * size)
    if kind == kinds.mjGEOM_SPHERE:
        return trimesh.creation.icosphere(2, size[0])
    if kind == kinds.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(2 * size[1], size[0], count=(16, 16))
    if kind == kinds.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(size[0], 2 * size[1], sections=24)
    if kind == kinds.mjGEOM_ELLIPSOID:
        return trimesh.creation.icosphere(2, 1.0).apply_scale(size)
    if kind == kinds.mjGEOM_MESH:
        mesh = m.mesh(m.geom_dataid[geom])
        first, start = mesh.vertadr[0], mesh.faceadr[0]
        vertices, faces = m.mesh_vert[first : first + mesh.vertnum[0]], m.mesh_face[start : start + mesh.facenum[0]]
        return trimesh.Trimesh(vertices, faces, process=False)
    return None
