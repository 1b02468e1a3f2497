"""Appearance of objects in Reality: a speckle pattern with texture for trackers.

The pattern covers copies of the geoms that only cameras see. It is projected along the axis of the body that is nearest
to a face's normal, so that faces of neighbouring geoms in one plane show one pattern.
"""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import ConvexHull

PERIOD = 0.06
"""Edge of the square after which the pattern repeats [m]."""
TEXELS = 128
"""Pixels along an edge of the pattern."""
GRAIN = (0.0012, 0.004)
"""Sizes of the fine and of the coarse speckles [m]."""
CONTRAST = 0.22
"""Standard deviation of the brightness around its mean of 1 - 2 * CONTRAST [-]."""
TEXTURE = "speckle"


def dress(spec: mujoco.MjSpec, bodies: tuple[str, ...]) -> mujoco.MjSpec:
    """Return a copy of a world whose bodies carry a pattern: boxes, spheres and convex meshes; others stay plain.

    Joints, names of bodies and their order are those of `spec`, so a state of the one is a state of the other.
    """
    spec = spec.copy()
    texture = spec.add_texture(
        name=TEXTURE, type=mujoco.mjtTexture.mjTEXTURE_2D, width=TEXELS, height=TEXELS, nchannel=3
    )
    texture.data = _speckle(np.random.default_rng(0)).tobytes()
    for body in bodies:
        for i, geom in enumerate(spec.body(body).geoms):
            corners = _hull_corners(spec, geom)
            if corners is not None:
                _wrap(spec, geom, corners, f"{body}_{i}_dressed")
    return spec


def _hull_corners(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> np.ndarray | None:
    """Return the corners of a box, the vertices of a mesh given by them, or 2,562 points of a sphere [m], geom frame,
    shape (n, 3); None for others.
    """
    if geom.type == mujoco.mjtGeom.mjGEOM_BOX:
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        return signs * np.array(geom.size)
    if geom.type == mujoco.mjtGeom.mjGEOM_SPHERE:
        import trimesh

        return np.asarray(trimesh.creation.icosphere(subdivisions=4, radius=geom.size[0]).vertices)
    if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = spec.mesh(geom.meshname)
        vertices = np.array(mesh.uservert).reshape(-1, 3) * np.array(mesh.scale)
        return vertices if len(vertices) else None
    return None


def _wrap(spec: mujoco.MjSpec, geom: mujoco.MjsGeom, corners: np.ndarray, name: str) -> None:
    """Turn a geom into the hull of its corners (n, 3) [m], with the pattern on it."""
    hull = ConvexHull(corners)
    outward = np.einsum("fk,fk->f", _triangle_normals(corners[hull.simplices]), hull.equations[:, :3]) > 0
    faces = np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.array(geom.quat))
    in_body = corners @ rotation.reshape(3, 3).T + np.array(geom.pos)
    mesh = spec.add_mesh(name=name)
    mesh.uservert = corners.ravel()
    mesh.userface = faces.ravel()
    mesh.usertexcoord = (_unfold(in_body[faces]) / PERIOD).ravel()
    mesh.userfacetexcoord = np.arange(faces.size)
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    material = spec.add_material(name=name, rgba=geom.rgba, specular=0.1)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = TEXTURE
    geom.type, geom.meshname, geom.material = mujoco.mjtGeom.mjGEOM_MESH, name, name


def _unfold(triangles: np.ndarray) -> np.ndarray:
    """Return places on the pattern [m], shape (f, 3, 2), of triangles in the body frame [m], shape (f, 3, 3).

    A face takes the two coordinates perpendicular to the axis nearest to its normal, moved by a step of its own for
    each of the six directions.
    """
    normal = _triangle_normals(triangles)
    axis = np.argmax(np.abs(normal), axis=1)
    row = np.arange(len(triangles))
    side = 2 * axis + (normal[row, axis] > 0)
    across = np.array([[1, 2], [2, 0], [0, 1]])[axis]
    flat = np.take_along_axis(triangles, across[:, None, :], axis=2)
    return flat + (side[:, None, None] * np.array([0.0137, 0.0229]))


def _triangle_normals(triangles: np.ndarray) -> np.ndarray:
    """Return the normals, not of unit length, shape (f, 3), of triangles, shape (f, 3, 3)."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def _speckle(rng: np.random.Generator) -> np.ndarray:
    """Return a grey pattern without seams, shape (TEXELS, TEXELS, 3), uint8."""
    layers = []
    for size in GRAIN:
        blurred = gaussian_filter(rng.normal(size=(TEXELS, TEXELS)), size / PERIOD * TEXELS / 2, mode="wrap")
        layers.append(blurred / blurred.std())
    brightness = 1 - 2 * CONTRAST + CONTRAST * np.sum(layers, axis=0) / np.sqrt(len(layers))
    grey = np.clip(255 * brightness, 0, 255).astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)
