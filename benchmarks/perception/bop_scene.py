"""A data set in BOP's format, rendered by Reality's camera: objects at rest on a table, seen by a moving camera.

For use where no data set of the benchmark is at hand. Three objects, none of them in the training of anything: a
carton, a can, which is round about its axis, and a stepped block. The table is not in the data set, as in BOP's.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import mujoco
import numpy as np

from concent_warp.reality.sensors.camera import record_depth_images
from concent_warp.reality.sensors.sensing import SensingCfg

if TYPE_CHECKING:
    import trimesh

MILLIMETRES = 1000.0
DEPTH_SCALE = 0.1
"""One unit of the depths [mm], as in YCB-V."""
PLACES = {
    "carton": (np.array([-0.09, 0.02, 0.05]), 0.5),
    "can": (np.array([0.05, 0.06, 0.05]), 0.0),
    "step": (np.array([0.03, -0.09, 0.02]), 1.9),
}
"""Position [m] and turn about the vertical [rad] of each object."""
COLOURS = {"carton": (0.75, 0.3, 0.25, 1), "can": (0.3, 0.45, 0.7, 1), "step": (0.75, 0.7, 0.3, 1)}
SENSING = SensingCfg(
    image_size=(480, 640), camera_fovy=40.0, rgb_blur=0.7, depth_correlation=0.8, disparity_step=0.0014
)
"""Camera with the imperfections of the benchmark of tracking."""


@dataclass(frozen=True)
class Orbit:
    """Motion of the camera around the objects."""

    images: int = 60
    rate: float = 30.0
    """Images a second [Hz]."""
    speed: float = 0.35
    """Angular velocity about the vertical [rad/s]."""
    radius: float = 0.65
    """Horizontal distance [m]."""
    height: float = 0.5
    """[m]."""
    start: float = 0.0
    """First angle [rad]."""


STEP = np.array([(-0.04, -0.03), (0.0, -0.03), (0.04, -0.03), (0.04, 0.03), (0.0, 0.03), (0.0, 0.0), (-0.04, 0.0)])
"""Outline of the stepped block [m]."""
STEP_FACES = np.array([(0, 1, 5), (0, 5, 6), (1, 2, 3), (1, 3, 5), (5, 3, 4)])
SYMMETRIC = {
    "can": {
        "symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}],
        "symmetries_discrete": [[1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]],
    }
}
"""Symmetries of objects that carry no pattern; the pattern breaks those of the carton."""
PATTERNED = ("carton", "step")
CAMERA_PLACE, CAMERA_TARGET = (1.0, 0.0, 0.6), (0.0, 0.0, 0.0)
"""Where the camera stands in Reality [m]: table and objects move before it."""


def shapes() -> dict[str, trimesh.Trimesh]:
    """Return the meshes of the objects [m] by name, each centred at the middle of its bounds."""
    import trimesh

    create = trimesh.creation
    block = create.extrude_triangulation(STEP, STEP_FACES, height=0.04)
    block.apply_translation(-block.bounds.mean(axis=0))
    return {
        "carton": create.box(extents=(0.08, 0.05, 0.1)),
        "can": create.cylinder(radius=0.033, height=0.1, sections=64),
        "step": block,
    }


def world() -> mujoco.MjSpec:
    """Return table and objects, all on one free body, with the lights."""
    kind = mujoco.mjtGeom
    spec = mujoco.MjSpec()
    table = spec.worldbody.add_body(name="table")
    table.add_freejoint()
    table.add_geom(type=kind.mjGEOM_BOX, size=[0.4, 0.4, 0.01], pos=[0, 0, -0.01], rgba=[0.55, 0.5, 0.45, 1])
    table.add_light(pos=[0.6, -0.4, 1.5], dir=[-0.35, 0.25, -1], diffuse=[0.6, 0.6, 0.6], castshadow=True)
    table.add_light(pos=[-0.8, 0.6, 1.4], dir=[0.5, -0.4, -1], diffuse=[0.3, 0.3, 0.3], castshadow=False)
    parts = {
        "carton": [(kind.mjGEOM_BOX, (0.04, 0.025, 0.05), (0, 0, 0))],
        "can": [(kind.mjGEOM_CYLINDER, (0.033, 0.05, 0), (0, 0, 0))],
        "step": [
            (kind.mjGEOM_BOX, (0.02, 0.03, 0.02), (0.02, 0, 0)),
            (kind.mjGEOM_BOX, (0.02, 0.015, 0.02), (-0.02, -0.015, 0)),
        ],
    }
    for name, pose in object_poses().items():
        body = table.add_body(name=name, pos=list(pose[:3, 3]), quat=list(_quaternion(pose)))
        for geom, size, place in parts[name]:
            body.add_geom(type=geom, size=list(size), pos=list(place), rgba=list(COLOURS[name]))
    return spec


def object_poses() -> dict[str, np.ndarray]:
    """Return the transforms of the objects to the table, shape (4, 4), by name."""
    found = {}
    for name, (place, angle) in PLACES.items():
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:3, 3] = place
        found[name] = pose
    return found


def camera_poses(orbit: Orbit) -> np.ndarray:
    """Return the transforms of the camera to the table, shape (T, 4, 4)."""
    angles = orbit.start + orbit.speed * np.arange(orbit.images) / orbit.rate
    places = [(orbit.radius * np.cos(a), orbit.radius * np.sin(a), orbit.height) for a in angles]
    return np.array([SensingCfg(camera_position=p, camera_target=(0, 0, 0.03)).pinhole().pose for p in places])


def write_bop_scene(
    root: Path, number: int, orbit: Orbit | None = None, sensing: SensingCfg = SENSING, seed: int = 0
) -> Path:
    """Render a scene, write it and the meshes in BOP's format, and return its folder.

    Args:
        root: Folder of the data set.
        number: Number of the scene.
        orbit: Motion of the camera.
        sensing: The camera.
        seed: Seed of its noise.
    """
    orbit = orbit or Orbit()
    sensing = replace(sensing, camera_position=CAMERA_PLACE, camera_target=CAMERA_TARGET)
    camera = sensing.pinhole()
    views = camera_poses(orbit)
    states = []
    for view in views:
        table = camera.pose @ np.linalg.inv(view)
        states.append(np.concatenate([table[:3, 3], _quaternion(table)]))
    time = np.arange(orbit.images) / orbit.rate
    bodies = PATTERNED if sensing.object_pattern else ()
    stream = record_depth_images(sensing, world(), bodies, time, np.array(states), np.random.default_rng(seed))
    _write_models(root / "models")
    folder = root / "test" / f"{number:06d}"
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    cameras: dict[str, Any] = {}
    truth: dict[str, Any] = {}
    for k, view in enumerate(views):
        name = f"{k + 1:06d}.png"
        cv2.imwrite(str(folder / "rgb" / name), cv2.cvtColor(stream.rgb[k], cv2.COLOR_RGB2BGR))
        units = np.rint(stream.depth[k] * MILLIMETRES / DEPTH_SCALE)
        cv2.imwrite(str(folder / "depth" / name), np.minimum(units, 65_535).astype(np.uint16))
        from_table = np.linalg.inv(view)
        cameras[str(k + 1)] = {
            "cam_K": camera.intrinsics.ravel().tolist(),
            "depth_scale": DEPTH_SCALE,
            "cam_R_w2c": from_table[:3, :3].ravel().tolist(),
            "cam_t_w2c": (MILLIMETRES * from_table[:3, 3]).tolist(),
        }
        truth[str(k + 1)] = [
            {
                "obj_id": row + 1,
                "cam_R_m2c": (from_table @ pose)[:3, :3].ravel().tolist(),
                "cam_t_m2c": (MILLIMETRES * (from_table @ pose)[:3, 3]).tolist(),
            }
            for row, pose in enumerate(object_poses().values())
        ]
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    (folder / "scene_gt.json").write_text(json.dumps(truth))
    return folder


def _write_models(folder: Path) -> None:
    """Write the meshes [mm] and what is known of them."""
    folder.mkdir(parents=True, exist_ok=True)
    described = {}
    for row, (name, mesh) in enumerate(shapes().items()):
        mesh = mesh.copy()
        mesh.apply_scale(MILLIMETRES)
        mesh.export(folder / f"obj_{row + 1:06d}.ply")
        low, size = mesh.bounds[0], mesh.extents
        apart = np.linalg.norm(mesh.vertices[:, None] - mesh.vertices[None], axis=-1)
        described[str(row + 1)] = {
            "diameter": float(apart.max()),
            **{f"min_{axis}": float(low[k]) for k, axis in enumerate("xyz")},
            **{f"size_{axis}": float(size[k]) for k, axis in enumerate("xyz")},
            **SYMMETRIC.get(name, {}),
        }
    (folder / "models_info.json").write_text(json.dumps(described, indent=1))


def _quaternion(pose: np.ndarray) -> np.ndarray:
    """Return the quaternion wxyz of a transform (4, 4), shape (4,)."""
    found = np.zeros(4)
    mujoco.mju_mat2Quat(found, np.ascontiguousarray(pose[:3, :3]).ravel())
    return found
