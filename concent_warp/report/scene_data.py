"""What the 3D views need of a scene and its contact geometry: primitives of each body, meshes, spheres."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

if TYPE_CHECKING:
    from concent_warp.events.sequence import ContactEventSequence
    from concent_warp.model import Model
    from concent_warp.scene.spheres.contact_geometry import ContactGeometry

SHAPES = {
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_MESH: "mesh",
    mujoco.mjtGeom.mjGEOM_PLANE: "box",
}
VISIBLE_GROUPS = 3
"""Geom groups below this one are drawn, as MuJoCo's viewer does."""
MOST_FACES = 4000
"""A mesh with more faces is drawn as its convex hull, so that the page stays small."""
PLANE_HALF_SIZE = 1.0
"""Half size at which an infinite plane is drawn [m]."""
MOVED_DISTANCE = 1e-4
"""A sphere is called moved when it ends farther than this from where it started [m]."""


def packed(array: np.ndarray) -> dict[str, str]:
    """Return numbers as the page unpacks them: little-endian 32-bit floats or integers in base64, flat."""
    integer = array.dtype.kind in "iub"
    data = np.ascontiguousarray(array, dtype="<i4" if integer else "<f4")
    return {"type": "i" if integer else "f", "data": base64.b64encode(data.tobytes()).decode()}


def scene_bodies(compiled: mujoco.MjModel) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the bodies that have something to draw, each with its geoms in the body frame, and the meshes by name."""
    bodies, meshes = [], {}
    for b in range(compiled.nbody):
        start = compiled.body_geomadr[b]
        rows = range(start, start + compiled.body_geomnum[b]) if start >= 0 else range(0)
        visible = [g for g in rows if compiled.geom_group[g] < VISIBLE_GROUPS] or list(rows)
        geoms = [_geom_data(compiled, g) for g in visible if int(compiled.geom_type[g]) in SHAPES]
        if geoms:
            bodies.append({"name": compiled.body(b).name or f"body{b}", "id": b, "geoms": geoms})
        for geom in geoms:
            if (name := geom.get("mesh")) is not None and name not in meshes:
                meshes[name] = _mesh_data(compiled, int(name))
    return bodies, meshes


def _geom_data(compiled: mujoco.MjModel, g: int) -> dict[str, Any]:
    """Return one geom: shape, half sizes [m], pose in the body frame, colour."""
    kind = int(compiled.geom_type[g])
    size = np.array(compiled.geom_size[g])
    position = np.array(compiled.geom_pos[g])
    material = compiled.geom_matid[g]
    colour = compiled.mat_rgba[material] if material >= 0 else compiled.geom_rgba[g]
    data: dict[str, Any] = {"shape": SHAPES[mujoco.mjtGeom(kind)]}
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        half = np.where(size[:2] > 0, np.minimum(size[:2], PLANE_HALF_SIZE), PLANE_HALF_SIZE)
        size = np.array([*half, 1e-3])
        position = position - 1e-3 * _rotation(compiled.geom_quat[g])[:, 2]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        data["mesh"] = str(int(compiled.geom_dataid[g]))
    data |= {
        "size": _rounded(size),
        "position": _rounded(position),
        "quaternion": _rounded(compiled.geom_quat[g]),
        "colour": [*_rounded(colour[:3]), 1.0 if colour[3] > 0.95 else round(float(max(colour[3], 0.25)), 3)],
    }
    return data


def _mesh_data(compiled: mujoco.MjModel, mesh: int) -> dict[str, Any]:
    """Return a mesh as the page has it."""
    vertices, faces = mesh_arrays(compiled, mesh)
    return {"vertices": packed(vertices), "faces": packed(faces.ravel())}


def mesh_arrays(compiled: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [m] (V, 3) and triangles (F, 3) of a mesh, or of its convex hull where it is large."""
    first, count = compiled.mesh_vertadr[mesh], compiled.mesh_vertnum[mesh]
    vertices = np.array(compiled.mesh_vert[first : first + count])
    first, count = compiled.mesh_faceadr[mesh], compiled.mesh_facenum[mesh]
    faces = np.array(compiled.mesh_face[first : first + count])
    if len(faces) > MOST_FACES:
        import trimesh

        hull = trimesh.convex.convex_hull(vertices[:: max(1, len(vertices) // 3000)])
        vertices, faces = np.asarray(hull.vertices), np.asarray(hull.faces)
    return vertices, faces


def geometry_data(
    models: Mapping[str, Model], events: Mapping[str, ContactEventSequence] | None
) -> dict[str, Any] | None:
    """Return the spheres of the first and the last model and what became of each; None where there are none to show."""
    names = list(models)
    first, last = models[names[0]].geometry, models[names[-1]].geometry
    if first is None or last is None or first.bodies != last.bodies or len(first) != len(last):
        return None
    moved = np.linalg.norm(last.position - first.position, axis=1)
    touched, gripped = _touched_spheres(events or {}, len(last))
    state = np.select([moved > MOVED_DISTANCE, gripped, touched], ["moved", "gripped", "touched"], "other")
    data: dict[str, Any] = {
        "bodies": sorted(last.bodies, key=lambda name: -int((state[last.of(name)] == "moved").sum())),
        "state": state.tolist(),
        "facts": {body: _facts(last, body, moved, touched, gripped) for body in last.bodies},
    }
    for name, geometry in ((names[0], first), (names[-1], last)):
        data[name] = {
            "body": packed(np.array([data["bodies"].index(geometry.bodies[b]) for b in geometry.body], dtype=int)),
            "position": packed(geometry.position),
            "radius": packed(geometry.radius),
        }
    return data


def _touched_spheres(events: Mapping[str, ContactEventSequence], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which spheres touched anything, and which the robot touched, in any demonstration, (S,) bool each."""
    touched, gripped = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    for sequence in events.values():
        for contact in sequence.contacts:
            pair = sequence.entity[contact.a], sequence.entity[contact.b]
            for one, other in (pair, pair[::-1]):
                if one.sphere is not None and one.sphere < count:
                    touched[one.sphere] = True
                    gripped[one.sphere] |= other.role == "robot"
    return touched, gripped


def _facts(geometry: ContactGeometry, body: str, moved: np.ndarray, touched: np.ndarray, gripped: np.ndarray) -> str:
    """Return a line on the spheres of a body."""
    rows = geometry.of(body)
    far = moved[rows][moved[rows] > MOVED_DISTANCE] * 1e3
    text = f"{len(rows)} spheres; {len(far)} moved"
    if len(far):
        text += f" by {far.mean():.1f} mm on average, {far.max():.1f} mm at most"
    by_robot = gripped[rows].sum()
    return f"{text}; {by_robot} touched by the robot, {(touched & ~gripped)[rows].sum()} by other things alone."


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a quaternion wxyz."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def _rounded(values: np.ndarray) -> list[float]:
    """Return numbers with six digits after the point."""
    return [round(float(v), 6) for v in values]
