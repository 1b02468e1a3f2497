"""A picture of unexplained forces: the objects with arrows where the forces act, and the forces of joints over time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from concent_warp.files import new_file

if TYPE_CHECKING:
    import trimesh

    from concent_warp.diagnosis.forces.force_data import JointForce
    from concent_warp.diagnosis.forces.result import UnexplainedForces
    from concent_warp.model import Model

ARROW_LENGTH = 0.7
"""Length of the largest arrow over the size of its object."""
MAX_JOINTS = 4
"""Joints shown, those farthest beyond noise."""
FORCE_COLOUR, SHAPE_COLOUR, NOISE_COLOUR = "#d62728", "#8fa8c4", "#b8c4d0"


def plot_location(location: UnexplainedForces, model: Model, path: Path) -> None:
    """Draw a location as an image.

    Args:
        location: What was found.
        model: The model that it was found in, for the shapes of its objects.
        path: The image; its suffix determines the format.
    """
    import matplotlib.pyplot as plt

    m = model.compile()
    arrows = location.arrows()
    bodies = list(dict.fromkeys(arrow["body"] for arrow in arrows)) or [body.body for body in location.bodies[:1]]
    joints = location.joints[:MAX_JOINTS]
    columns = max(len(bodies), 1)
    heights = [3.6] * bool(bodies) + [1.5] * len(joints)
    figure = plt.figure(figsize=(4.6 * columns if bodies else 7.5, sum(heights) or 1.0), layout="constrained")
    grid = figure.add_gridspec(max(len(heights), 1), columns, height_ratios=heights or [1])
    for i, name in enumerate(bodies):
        axes = figure.add_subplot(grid[0, i], projection="3d")
        _draw_body(axes, m, name, [arrow for arrow in arrows if arrow["body"] == name])
    for i, joint in enumerate(joints):
        _draw_joint(figure.add_subplot(grid[bool(bodies) + i, :]), joint, last=i == len(joints) - 1)
    with new_file(path) as partial:
        figure.savefig(partial, format=path.suffix.lstrip(".") or "png", dpi=130)
    plt.close(figure)


def _draw_body(axes: Any, m: mujoco.MjModel, name: str, arrows: list[dict[str, Any]]) -> None:
    """Draw a body in its own frame [mm], with arrows that end where the forces act."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    body = m.body(name).id
    corners = []
    for g in range(int(m.body_geomadr[body]), int(m.body_geomadr[body] + m.body_geomnum[body])):
        if (mesh := _geom_mesh(m, g)) is None:
            continue
        triangles = 1e3 * np.asarray(mesh.triangles)
        corners.append(triangles.reshape(-1, 3))
        axes.add_collection3d(Poly3DCollection(triangles, facecolor=SHAPE_COLOUR, edgecolor="none", alpha=0.25))
        edges = 1e3 * np.asarray(mesh.vertices)[mesh.face_adjacency_edges[mesh.face_adjacency_angles > 0.5]]
        for edge in edges:
            axes.plot(*edge.T, color="#41576e", linewidth=0.7)
    points = np.concatenate(corners) if corners else np.array([[-1.0, -1, -1], [1, 1, 1]])
    size = float(np.ptp(points, axis=0).max())
    most = max((float(np.linalg.norm(arrow["vector"])) for arrow in arrows), default=1.0)
    tails = [points.min(axis=0), points.max(axis=0)]
    for arrow in arrows:
        tip = 1e3 * np.array(arrow["point"])
        vector = ARROW_LENGTH * size * np.array(arrow["vector"]) / most
        tails.append(tip - vector)
        axes.quiver(*(tip - vector), *vector, color=FORCE_COLOUR, linewidth=2, arrow_length_ratio=0.25)
        axes.scatter(*tip, color=FORCE_COLOUR, s=14)
        axes.text(*(tip - vector), f" {arrow['label']}", color=FORCE_COLOUR, fontsize=8)
    low, high = np.min(tails, axis=0), np.max(tails, axis=0)
    half = 0.55 * float((high - low).max())
    middle = (low + high) / 2
    for setter, value in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, strict=True):
        setter(value - half, value + half)
    axes.set_box_aspect((1, 1, 1), zoom=0.88)
    if arrows:
        # From the side that the first arrow ends on.
        x, y = np.array(arrows[0]["point"])[:2] - points.mean(axis=0)[:2] / 1e3
        axes.view_init(elev=25, azim=float(np.degrees(np.arctan2(y, x))) - 40)
    axes.set_xlabel("x [mm]", fontsize=8)
    axes.set_ylabel("y [mm]", fontsize=8)
    axes.set_zlabel("z [mm]", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.set_title(name if arrows else f"{name}: no unexplained force with a place", fontsize=9)


def _draw_joint(axes: Any, joint: JointForce, *, last: bool) -> None:
    """Draw the force of a joint over time, demonstrations one after the other, with what noise leaves."""
    offset = 0.0
    for series in joint.series:
        time = series.time + offset
        axes.fill_between(time, -2 * series.std, 2 * series.std, color=NOISE_COLOUR, alpha=0.5, linewidth=0)
        axes.plot(time, series.force, color=FORCE_COLOUR if joint.significant else "#41576e", linewidth=0.9)
        offset += float(series.time[-1] - series.time[0]) + 0.5
    axes.axhline(0, color="#41576e", linewidth=0.5)
    patterns = joint.dependences.patterns
    about = f": goes with {patterns[0].feature}" if joint.significant and patterns else ""
    axes.set_title(f"{joint.joint}{about} (band: 2 standard deviations of the noise)", fontsize=9, loc="left")
    axes.set_ylabel(f"force [{joint.unit}]", fontsize=8)
    axes.tick_params(labelsize=7)
    if last:
        axes.set_xlabel("time [s]", fontsize=8)


def _geom_mesh(m: mujoco.MjModel, g: int) -> trimesh.Trimesh | None:
    """Return a geom as triangles in the frame of its body [m]; None for planes and height fields."""
    import trimesh

    shape = mujoco.mjtGeom
    kind, size = int(m.geom_type[g]), m.geom_size[g]
    if kind == shape.mjGEOM_BOX:
        mesh = trimesh.creation.box(extents=2 * size)
    elif kind == shape.mjGEOM_SPHERE:
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=size[0])
    elif kind == shape.mjGEOM_ELLIPSOID:
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
        mesh.apply_scale(size)
    elif kind == shape.mjGEOM_CYLINDER:
        mesh = trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=24)
    elif kind == shape.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(radius=size[0], height=2 * size[1], count=[16, 16])
        mesh.apply_translation([0, 0, -float(mesh.bounds.mean(axis=0)[2])])
    elif kind == shape.mjGEOM_MESH:
        row = int(m.geom_dataid[g])
        vertices = m.mesh_vert[m.mesh_vertadr[row] :][: m.mesh_vertnum[row]]
        faces = m.mesh_face[m.mesh_faceadr[row] :][: m.mesh_facenum[row]]
        mesh = trimesh.Trimesh(np.array(vertices), np.array(faces), process=False)
    else:
        return None
    matrix = np.eye(4)
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, m.geom_quat[g])
    matrix[:3, :3], matrix[:3, 3] = rotation.reshape(3, 3), m.geom_pos[g]
    mesh.apply_transform(matrix)
    return mesh
