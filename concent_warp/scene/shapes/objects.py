"""Objects from files: a mesh, a point cloud or Gaussian splats become a free body of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.errors import SceneError
from concent_warp.scene.shapes.cloud import PointCloud
from concent_warp.scene.shapes.mesh import MeshSolid, closed_mesh, convex_hull
from concent_warp.scene.shapes.ply import read_header, read_vertices
from concent_warp.scene.shapes.splat import is_splats, read_splats
from concent_warp.scene.shapes.surface import Surface

if TYPE_CHECKING:
    import trimesh

MAX_EXTENT = 10.0
"""Extent [m] above which an object is taken to be given in another unit."""
MIN_EXTENT = 1e-4
"""Extent [m] below which an object is taken to be given in another unit."""
MAX_FILE_BYTES = 1_000_000_000
"""Larger files are refused."""
MESH_SUFFIXES = (".stl", ".obj", ".off", ".glb", ".gltf", ".3mf")
POINT_CLOUD_SUFFIXES = (".xyz", ".txt", ".npy")


@dataclass(frozen=True)
class SceneObject:
    """An object read from a file, in its own frame."""

    name: str
    """Name of the body."""
    vertices: np.ndarray
    """Vertices of a closed mesh [m], for looks and inertia, shape (v, 3)."""
    faces: np.ndarray
    """Vertex indices, shape (f, 3)."""
    surface: Surface
    """Where contact spheres are sampled: the mesh itself, or the points that it was made from."""
    mass: float
    """Mass [kg]."""
    com: np.ndarray
    """Centre of mass [m], shape (3,)."""
    inertia: np.ndarray
    """Inertia tensor about the centre of mass [kg m^2], shape (3, 3)."""
    friction: float
    """Sliding friction coefficient [-]."""

    def add_to(
        self,
        spec: mujoco.MjSpec,
        *,
        position: Sequence[float] = (0.0, 0.0, 0.0),
        quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
    ) -> mujoco.MjsBody:
        """Add the object to a scene as a body with a free joint.

        Args:
            spec: the scene.
            position: position of the object's frame [m], shape (3,).
            quaternion: its orientation, wxyz, shape (4,).

        Raises `SceneError` where the scene has a body of that name.
        """
        if spec.body(self.name) is not None:
            raise SceneError(f"the scene has a body {self.name!r} already", fix="give the object another name")
        spec.add_mesh(
            name=f"{self.name}_mesh",
            uservert=self.vertices.ravel(),
            userface=self.faces.astype(np.int32).ravel(),
            # The inertia is explicit; this only spares MuJoCo's complaint about small volumes.
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
        )
        body = spec.worldbody.add_body(name=self.name, pos=position, quat=quaternion)
        body.add_freejoint(name=f"{self.name}_free")
        body.explicitinertial = True
        body.mass, body.ipos = self.mass, self.com
        tensor = self.inertia
        body.fullinertia = [*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2]]
        body.add_geom(
            name=f"{self.name}_geom",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"{self.name}_mesh",
            friction=[self.friction, 0.005, 0.0001],
            mass=0,
        )
        return body


def load_object(
    path: Path,
    name: str,
    *,
    mass: float | None = None,
    density: float = 1000.0,
    scale: float = 1.0,
    friction: float = 0.5,
    opacity: float = 0.5,
) -> SceneObject:
    """Read an object from a mesh, a point cloud (``.ply``, ``.xyz``, ``.txt``, ``.npy``) or a 3DGS ``.ply``.

    A mesh that is not watertight is replaced by its convex hull, with a warning. Points keep their own surface for the
    sampling of spheres; looks and inertia are those of their convex hull, which fills holes.

    Args:
        path: the file; coordinates are metres once multiplied by `scale`.
        name: name of the body.
        mass: mass [kg]; None takes density times volume.
        density: density [kg/m^3].
        scale: factor from the file's unit to metres [-], say 0.001 for millimetres.
        friction: sliding friction coefficient [-].
        opacity: splats fainter than this are not surface [0 to 1].

    Raises `SceneError` where the file is missing, broken, or of a size that speaks of another unit.
    """
    for what, value in (("scale", scale), ("density", density), ("mass", 1.0 if mass is None else mass)):
        if not 0 < value < np.inf:
            raise SceneError(f"the {what} of object {name!r} is not right", expected="> 0", found=value)
    path = Path(path)
    if not path.is_file():
        raise SceneError("no such file for an object", where=path, fix="check the path")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise SceneError(
            "the file is too large for an object", where=path, expected=f"at most {MAX_FILE_BYTES:,} bytes"
        )
    suffix = path.suffix.lower()
    points: np.ndarray | None = None
    if suffix in MESH_SUFFIXES or (suffix == ".ply" and read_header(path).count("face")):
        mesh = read_mesh(path)
        _check_size(mesh.bounds * scale, path, scale)
        mesh.apply_scale(scale)
        mesh = closed_mesh(mesh, str(path))
    elif suffix == ".ply" or suffix in POINT_CLOUD_SUFFIXES:
        points = read_points(path, opacity) * scale
        if len(points) < 4:
            raise SceneError("too few points for an object", where=path, expected="at least 4", found=len(points))
        _check_size(np.array([points.min(axis=0), points.max(axis=0)]), path, scale)
        mesh = convex_hull(points, str(path))
    else:
        raise SceneError(
            "an object cannot be read from this kind of file",
            where=path,
            expected=[*MESH_SUFFIXES, ".ply", *POINT_CLOUD_SUFFIXES],
            found=suffix,
        )
    if not mesh.volume > 0:
        raise SceneError("the object has no volume", where=path, expected="> 0 m^3", found=mesh.volume)
    mesh.density = density if mass is None else mass / mesh.volume
    vertices, faces = np.array(mesh.vertices, dtype=float), np.array(mesh.faces, dtype=int)
    solid = MeshSolid(vertices, faces) if points is None else PointCloud.of(points, name=str(path))
    return SceneObject(
        name=name,
        vertices=vertices,
        faces=faces,
        surface=Surface.of_solids([solid], friction=friction, name=name),
        mass=float(mesh.mass),
        com=np.array(mesh.center_mass),
        inertia=np.array(mesh.moment_inertia),
        friction=friction,
    )


def read_mesh(path: Path) -> trimesh.Trimesh:
    """Read a triangle mesh as `trimesh.Trimesh`."""
    import trimesh

    try:
        mesh = trimesh.load_mesh(path)
    except Exception as error:  # trimesh's readers raise whatever their parsers do
        raise SceneError("the mesh cannot be read", where=path, found=f"{type(error).__name__}: {error}") from None
    if isinstance(mesh, trimesh.Scene):
        mesh = mesh.to_mesh()
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces) or not np.isfinite(mesh.vertices).all():
        raise SceneError("the file holds no triangle mesh, or vertices that are not finite", where=path)
    return mesh


def read_points(path: Path, opacity: float = 0.5) -> np.ndarray:
    """Read surface points in the unit of the file, shape (n, 3); of splats the opaque ones."""
    if path.suffix.lower() == ".ply":
        if is_splats(read_header(path)):
            return read_splats(path).surface_points(opacity)
        values = read_vertices(path)
        if not {"x", "y", "z"} <= set(values):
            raise SceneError("the PLY file has no coordinates", where=path, expected="x, y, z", found=sorted(values))
        points = np.stack([values["x"], values["y"], values["z"]], axis=1)
    else:
        try:
            table = np.load(path, allow_pickle=False) if path.suffix.lower() == ".npy" else np.loadtxt(path, ndmin=2)
            points = np.asarray(table, dtype=float)
        except Exception as error:  # NumPy raises whatever its parsers do, and MemoryError where a header lies
            found = " ".join(str(error).split())[:300] or type(error).__name__
            raise SceneError("the points cannot be read", where=path, expected="rows of x y z", found=found) from None
    if points.ndim != 2 or points.shape[1] < 3:
        raise SceneError("the points have the wrong shape", where=path, expected="(n, 3)", found=points.shape)
    if not np.isfinite(points[:, :3]).all():
        raise SceneError("the points hold coordinates that are not finite", where=path)
    return points[:, :3]


def _check_size(bounds: np.ndarray, path: Path, scale: float) -> None:
    """Refuse an object whose size speaks of another unit; `bounds` [m] has shape (2, 3)."""
    extent = float(np.ptp(bounds, axis=0).max())
    if extent > MAX_EXTENT:
        fix = f"looks like millimetres, pass scale={0.001 * scale:g}"
    elif extent < MIN_EXTENT:
        fix = f"looks like another unit, pass a scale above {scale:g}"
    else:
        return
    raise SceneError(
        "the object's size is not one that a robot handles", where=path, expected=f"{MIN_EXTENT:g} to {MAX_EXTENT:g} m",
        found=f"{extent:.3g} m", fix=fix,
    )  # fmt: skip
