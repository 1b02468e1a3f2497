"""The surface of a body: the union of its geoms, in the body frame.

The signed distance of the union is the smallest of its geoms' distances. Outside it is exact. Inside it never claims
more depth than there is, and it is exact where the nearest surface point belongs to the geom in which the point lies
deepest; across a seam it is too shallow, because each geom sees only its own faces. So a sphere with
``distance <= -radius`` lies within the union wherever the geoms are. Geoms that overlap by a sphere's diameter or more
leave no gap at the seam; geoms that merely touch keep spheres a radius away from it, on both sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import mujoco
import numpy as np

from concent_warp.checks import Count, Positive
from concent_warp.errors import SceneError
from concent_warp.scene.scene import Scene
from concent_warp.scene.shapes.solid import Box, Capsule, Cylinder, Distances, Ellipsoid, PlacedSolid, Solid


@dataclass(frozen=True)
class SurfaceCfg:
    """How the outer surface of a union is sampled."""

    probe_distance: Positive = 1e-6
    """Distance from a surface point to the probe that distinguishes outer faces from inner ones, over the root of the
    largest area [-]: above rounding, below the gaps between faces."""
    max_batches: Count = 200
    """Batches of samples after which a union counts as without outer surface [-]: as many as a surface needs of which
    one in 200 points is outer."""
    area_samples: Count = 20_000
    """Samples from which the area of a union is estimated [-], to about 1 %."""


@dataclass(frozen=True)
class Surface:
    """The outer surface of a union of solids."""

    solids: tuple[Solid, ...]
    friction: np.ndarray
    """Sliding friction coefficient of each solid [-], shape (len(solids),)."""
    name: str = "<surface>"
    """What it is the surface of, for messages."""
    cfg: SurfaceCfg = field(default_factory=SurfaceCfg)
    """Settings."""

    @staticmethod
    def of_body(scene: Scene, body: str) -> Surface:
        """Return the surface of a body of a scene.

        It is made of the geoms that can collide; of all geoms of the body where none can.

        Raises `SceneError` where the body is missing, has no geoms, or one without a closed surface (plane, hfield).
        """
        model = scene.model
        row = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)
        if row < 0:
            known = [model.body(i).name for i in range(1, model.nbody)]
            raise SceneError(f"no body {body!r} in the scene", where=scene.source, expected=f"one of {known}")
        geoms = np.flatnonzero(model.geom_bodyid == row)
        collides = geoms[(model.geom_contype[geoms] != 0) | (model.geom_conaffinity[geoms] != 0)]
        geoms = collides if len(collides) else geoms
        if not len(geoms):
            raise SceneError(
                f"body {body!r} has no geoms to sample a surface from", where=scene.source, fix="give it a geom"
            )
        solids = tuple(_geom_solid(scene, int(g)) for g in geoms)
        return Surface(solids, model.geom_friction[geoms, 0].copy(), body)

    @staticmethod
    def of_solids(solids: Sequence[Solid], *, friction: float = 0.5, name: str = "<surface>") -> Surface:
        """Return the surface of a union of solids with one friction coefficient [-]."""
        return Surface(tuple(solids), np.full(len(solids), friction), name)

    def distance(self, points: np.ndarray) -> Distances:
        """Return signed distances [m], shape (n,), and their unit gradients, shape (n, 3), at `points` [m], (n, 3)."""
        points = np.asarray(points, dtype=float)
        distance, gradient = self.solids[0].distance(points)
        for solid in self.solids[1:]:
            other, other_gradient = solid.distance(points)
            nearer = other < distance
            distance = np.where(nearer, other, distance)
            gradient = np.where(nearer[:, None], other_gradient, gradient)
        return distance, gradient

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return signed distances [m], negative inside, shape (n,), at `points` [m], shape (n, 3)."""
        return self.distance(points)[0]

    def owner(self, points: np.ndarray) -> np.ndarray:
        """Return the index of the solid that each point lies deepest in or nearest to, shape (n,)."""
        return np.argmin([solid.distance(points)[0] for solid in self.solids], axis=0)

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return points [m] sampled uniformly from the outer surface, with outward normals, each (count, 3)."""
        points: list[np.ndarray] = []
        normals: list[np.ndarray] = []
        found = 0
        for _ in range(self.cfg.max_batches):
            batch, batch_normals, outer = self.sample_all(max(2 * (count - found), 64), rng)
            points.append(batch[outer])
            normals.append(batch_normals[outer])
            found += int(outer.sum())
            if found >= count:
                return np.concatenate(points)[:count], np.concatenate(normals)[:count]
        raise SceneError(f"the surface of {self.name!r} cannot be sampled", expected=f"{count} points", found=found)

    @cached_property
    def area(self) -> float:
        """Area of the outer surface [m^2]; for a union an estimate from `SurfaceCfg.area_samples` points."""
        whole = sum(solid.area for solid in self.solids)
        if len(self.solids) == 1:
            return whole
        return whole * float(self.sample_all(self.cfg.area_samples, np.random.default_rng(0))[2].mean())

    def sample_all(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sample the surfaces of all solids and determine which points lie on the outer surface of the union.

        A point is outer if a probe just outside it is outside every solid, which drops points within another solid and
        faces where two solids touch. A face that two solids share is left to the first of them.

        Returns:
            Points [m] and normals, shape (count, 3), in random order, and whether each is outer, shape (count,).
        """
        areas = np.array([solid.area for solid in self.solids])
        owner = rng.choice(len(areas), size=count, p=areas / areas.sum())
        points, normals = np.empty((count, 3)), np.empty((count, 3))
        for k, solid in enumerate(self.solids):
            mine = owner == k
            points[mine], normals[mine] = solid.sample(int(mine.sum()), rng)
        outer = np.ones(count, dtype=bool)
        if len(self.solids) > 1:
            step = self.cfg.probe_distance * np.sqrt(areas.max())
            for k, solid in enumerate(self.solids):
                others = owner != k
                probed = solid.distance(points[others] + step * normals[others])[0]
                outer[others] &= probed > step / 2
                later = owner > k
                outer[later] &= solid.distance(points[later])[0] > step / 2
        return points, normals, outer


def _geom_solid(scene: Scene, geom: int) -> Solid:
    """Return the solid of one geom of the compiled scene, in the frame of its body."""
    model = scene.model
    size = model.geom_size[geom]
    kinds = mujoco.mjtGeom
    kind = kinds(model.geom_type[geom])
    solid: Solid
    if kind == kinds.mjGEOM_BOX:
        solid = Box(size.copy())
    elif kind == kinds.mjGEOM_SPHERE:
        solid = Capsule(float(size[0]))
    elif kind == kinds.mjGEOM_CAPSULE:
        solid = Capsule(float(size[0]), float(size[1]))
    elif kind == kinds.mjGEOM_CYLINDER:
        solid = Cylinder(float(size[0]), float(size[1]))
    elif kind == kinds.mjGEOM_ELLIPSOID:
        solid = Ellipsoid(size.copy())
    elif kind == kinds.mjGEOM_MESH:
        import trimesh

        from concent_warp.scene.shapes.mesh import MeshSolid

        mesh = model.mesh(model.geom_dataid[geom])
        first, last = mesh.vertadr[0], mesh.vertadr[0] + mesh.vertnum[0]
        start, stop = mesh.faceadr[0], mesh.faceadr[0] + mesh.facenum[0]
        shape = trimesh.Trimesh(model.mesh_vert[first:last], model.mesh_face[start:stop], process=False)
        solid = MeshSolid.of(shape, f"mesh {mesh.name!r} in {scene.source}")
    else:
        body = model.body(model.geom_bodyid[geom]).name
        raise SceneError(
            f"geom {model.geom(geom).name or geom} of body {body!r} has no closed surface",
            where=scene.source,
            expected="box, sphere, capsule, cylinder, ellipsoid or mesh",
            found=kind.name.removeprefix("mjGEOM_").lower(),
        )
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    return PlacedSolid(solid, rotation.reshape(3, 3), model.geom_pos[geom].copy())
