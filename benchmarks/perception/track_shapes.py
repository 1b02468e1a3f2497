"""First poses of shapes other than the block, at rest on a table, in a frame of Reality's camera.

Each shape is dropped from a random orientation and filmed where it comes to rest, alone and behind a post that hides
part of it. The post, the table and their places are known to the search; nothing is known of the shape's pose.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from concent_warp.perception.pinhole import pixel_grid
from concent_warp.perception.tracking.alignment.search import find_pose
from concent_warp.perception.tracking.cfg import TrackCfg
from concent_warp.perception.tracking.geometry.pose import pose_of, twist_between
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.shape import TrackedShape
from concent_warp.perception.tracking.geometry.symmetry import symmetry_of
from concent_warp.perception.tracking.geometry.view import View
from concent_warp.reality.sensors.camera import record_depth_images
from concent_warp.reality.sensors.sensing import SensingCfg
from concent_warp.scene.scene import Scene

BODY = "thing"
TARGET = np.array([0.48, -0.02, 0.02])
"""Where the camera looks [m]."""
PLACE = 0.06
"""Largest distance of the shape from there along either side of the table [m]."""
DROP, REST = 0.09, 1.5
"""Height of the fall [m] and time until it rests [s]."""
POST_DISTANCE = 0.07
"""Distance of the post from the shape, towards the camera, in the plane of the table [m]."""
HIDDEN = (0.3, 0.6)
"""Share of the shape's pixels that it hides [-]."""
MAX_POSTS = 100
"""Places of the post that are tried."""
GOOD = (0.002, 3.0)
"""Error of a first pose that counts as found [m, degrees]."""
VIEWS = ("in full view", "behind a post")

SCENE = """
<mujoco>
  <option timestep="0.002"/>
  <visual><headlight ambient="0.4 0.4 0.4" diffuse="0.3 0.3 0.3"/></visual>
  <asset>{assets}</asset>
  <worldbody>
    <light pos="0.6 -0.4 1.6" dir="-0.1 0.3 -1" castshadow="false"/>
    <geom name="table" type="box" size="0.4 0.4 0.02" pos="0.48 -0.02 -0.02" rgba="0.55 0.5 0.45 1"/>
    <body name="post" pos="{post}"><geom type="box" size="0.01 0.01 0.08" rgba="0.25 0.3 0.35 1"/></body>
    <body name="thing" pos="0.48 -0.02 0.1"><freejoint/>{geoms}</body>
  </worldbody>
</mujoco>
"""


def _mesh(name: str, mesh: trimesh.Trimesh) -> str:
    """Return a closed mesh as an asset of MJCF."""
    vertex = " ".join(f"{v:.9g}" for v in np.asarray(mesh.vertices).ravel())
    face = " ".join(str(int(v)) for v in np.asarray(mesh.faces).ravel())
    return f'<mesh name="{name}" vertex="{vertex}" face="{face}" inertia="exact"/>'


def _wedge() -> tuple[str, str]:
    """Return assets and geoms of a ramp of 60 x 36 x 26 mm."""
    corners = np.array([[x, y, z] for y in (0.0, 0.036) for x, z in ((0.0, 0.0), (0.06, 0.0), (0.0, 0.026))])
    mesh = trimesh.convex.convex_hull(corners)
    return _mesh("wedge", mesh), '<geom type="mesh" mesh="wedge" rgba="0.89 0.47 0.2 1"/>'


def _bracket() -> tuple[str, str]:
    """Return assets and geoms of an L of two plates of unequal length."""
    return "", (
        '<geom type="box" size="0.03 0.014 0.008" rgba="0.3 0.6 0.75 1"/>'
        '<geom type="box" size="0.008 0.014 0.0135" pos="-0.022 0 0.0215" rgba="0.3 0.6 0.75 1"/>'
    )


def _cylinder() -> tuple[str, str]:
    """Return assets and geoms of a cylinder of 36 mm diameter and 60 mm height."""
    return "", '<geom type="cylinder" size="0.018 0.03" rgba="0.75 0.72 0.3 1"/>'


def _mug() -> tuple[str, str]:
    """Return assets and geoms of a hollow cup with a handle."""
    inner, outer, height, floor = 0.023, 0.0265, 0.056, 0.004
    profile = np.array([[0, 0], [outer, 0], [outer, height], [inner, height], [inner, floor], [0, floor]])
    cup = trimesh.creation.revolve(profile, sections=48)
    bar = 'type="box" rgba="0.35 0.65 0.4 1"'
    return _mesh("cup", cup), (
        '<geom type="mesh" mesh="cup" rgba="0.35 0.65 0.4 1"/>'
        f'<geom {bar} size="0.009 0.004 0.003" pos="0.0345 0 {0.2 * height:g}"/>'
        f'<geom {bar} size="0.009 0.004 0.003" pos="0.0345 0 {0.8 * height:g}"/>'
        f'<geom {bar} size="0.003 0.004 {0.3 * height + 0.003:g}" pos="0.0435 0 {0.5 * height:g}"/>'
    )


SHAPES: dict[str, Callable[[], tuple[str, str]]] = {
    "wedge": _wedge,
    "L-shaped bracket": _bracket,
    "cylinder": _cylinder,
    "mug": _mug,
}


def film(name: str, seed: int, *, hidden: bool, sensing: SensingCfg) -> tuple[Scene, View, np.ndarray]:
    """Return the scene, a frame, and the state (nq,) of a shape at rest."""
    rng = np.random.default_rng([seed, list(SHAPES).index(name)])
    assets, geoms = SHAPES[name]()
    place = TARGET[:2] + rng.uniform(-PLACE, PLACE, 2)
    state = np.concatenate([place, [DROP], Rotation.random(rng=rng).as_quat(scalar_first=True)])
    away = SCENE.format(assets=assets, geoms=geoms, post="-1 0 0.08")
    model = mujoco.MjModel.from_xml_string(away)
    data = mujoco.MjData(model)
    data.qpos[:] = state
    mujoco.mj_step(model, data, int(REST / model.opt.timestep))
    state = data.qpos.copy()
    if hidden:
        away = _behind_post(assets, geoms, state, sensing, rng)
    spec = mujoco.MjSpec.from_string(away)
    stream = record_depth_images(sensing, spec, (), np.zeros(1), state[None], rng)
    scene = Scene(away)
    return scene, View(sensing.pinhole(), stream.rgb[0], stream.depth[0]), state


def _behind_post(assets: str, geoms: str, state: np.ndarray, sensing: SensingCfg, rng: np.random.Generator) -> str:
    """Return the scene with the post where it hides a share of the shape's pixels that is within `HIDDEN`."""
    ahead = np.array(sensing.camera_position[:2]) - state[:2]
    ahead /= np.linalg.norm(ahead)
    across, shown = np.array([-ahead[1], ahead[0]]), 0
    pixels = pixel_grid(*sensing.image_size)[::2, ::2].reshape(-1, 2)
    for k in range(MAX_POSTS + 1):
        post = state[:2] + POST_DISTANCE * ahead + rng.uniform(-0.04, 0.04) * across
        scene = SCENE.format(assets=assets, geoms=geoms, post=f"{post[0]} {post[1]} 0.08" if k else "-1 0 0.08")
        renderer = RayRenderer(Scene(scene).model)
        renderer.set_state(state)
        own = int((renderer.cast(sensing.pinhole(), pixels).body == renderer.model.body(BODY).id).sum())
        if k == 0:
            shown = own
        elif HIDDEN[0] <= 1 - own / shown <= HIDDEN[1]:
            return scene
    raise RuntimeError("no place of the post hides as much of the shape as asked for")


def measure(name: str, seed: int, sensing: SensingCfg) -> dict[str, Any]:
    """Return what a search finds of a shape in each view: found, refused, or wrong, and why."""
    results = {}
    for view_name in VIEWS:
        scene, view, state = film(name, seed, hidden=view_name == VIEWS[1], sensing=sensing)
        shape, cfg = TrackedShape.of_body(scene, BODY, 0), TrackCfg()
        symmetry, renderer = symmetry_of(shape, cfg.symmetry_tolerance), RayRenderer(scene.model)
        renderer.set_state(scene.model.qpos0)
        found = find_pose(renderer, view, shape, symmetry, cfg, np.random.default_rng(seed))
        truth = pose_of(state[:3], state[3:])
        results[view_name] = judged(found.fit and found.fit.pose, truth, symmetry) | {"reason": found.reason}
    return results


def judged(pose: np.ndarray | None, truth: np.ndarray, symmetry: Any) -> dict[str, Any]:
    """Return whether a pose (4, 4), up to symmetry, is the true one, and its errors [m, degrees]."""
    if pose is None:
        return {"result": "refused"}
    twist = twist_between(truth, symmetry.nearest(pose, truth))
    error = float(np.linalg.norm(twist[:3])), float(np.degrees(np.linalg.norm(twist[3:])))
    return {"result": "found" if error[0] < GOOD[0] and error[1] < GOOD[1] else "wrong", "error": error}
