"""A short RGB-D video of a block on a table, drawn by ray casting in a fraction of a second."""

from __future__ import annotations

import numpy as np

from concent_warp.perception.pinhole import Pinhole, pixel_grid
from concent_warp.perception.tracking.geometry.pose import moved
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.recording.recording import Demonstration, ImageStream, Recording
from concent_warp.scene.scene import Scene

XML = """
<mujoco>
  <worldbody>
    <geom name="table" type="plane" size="0 0 .1"/>
    <body name="wall"><geom type="box" size=".01 .04 .03" pos=".06 .08 .03"/></body>
    <body name="block" pos="0 0 .03"><freejoint/><geom name="block" type="box" size=".03 .025 .02" mass=".1"/></body>
  </worldbody>
</mujoco>
"""
SIZE, FOCAL = (180, 240), 450.0
"""Height and width [px], and focal length [px]."""
EYE, TARGET = np.array([0.35, -0.3, 0.4]), np.array([0.0, 0.0, 0.02])
COLOURS = {0: (150, 145, 140), 1: (90, 110, 170), 2: (230, 150, 70)}
"""Colours by the body's row."""
START = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.03], [0, 0, 0, 1]])


def poses(count: int) -> np.ndarray:
    """Return true poses of the block, shape (count, 4, 4): it slides and turns above the table."""
    steps = np.linspace(0, 1, count)
    return np.array([moved(START, s * np.array([-0.02, 0.04, 0.01, 0.0, 0.1, 0.4])) for s in steps])


def camera_pose() -> np.ndarray:
    forward = (TARGET - EYE) / np.linalg.norm(TARGET - EYE)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(forward, right), forward], axis=1), EYE
    return pose


def drawn(truth: np.ndarray, time: np.ndarray, task: str = "") -> Recording:
    """Return a recording of the block at poses (T, 4, 4), with a pattern on it, and noise of colour and depth."""
    scene, rng = Scene(XML), np.random.default_rng(0)
    intrinsics = np.array([[FOCAL, 0, SIZE[1] / 2], [0, FOCAL, SIZE[0] / 2], [0, 0, 1]])
    camera, renderer = Pinhole(intrinsics, camera_pose()), RayRenderer(scene.model)
    row, pixels = scene.model.body("block").id, pixel_grid(*SIZE).reshape(-1, 2)
    light = np.array([0.3, -0.5, 0.8])
    rgb, depth = [], []
    for pose in truth:
        renderer.set_state(scene.model.qpos0)
        renderer.place(row, pose)
        hits = renderer.cast(camera, pixels)
        points = camera.position + hits.depth[:, None] * hits.rays
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        pattern = np.sin(500 * x + 1) * np.sin(430 * y + 2) * np.sin(470 * z + 3)
        shade = 0.45 + 0.55 * np.maximum(hits.normal @ light, 0) + 0.5 * np.where(hits.body == row, pattern, 0)
        colour = np.array([COLOURS[int(b)] for b in hits.body]) * shade[:, None]
        rgb.append(np.clip(colour + rng.normal(0, 2, colour.shape), 0, 255).astype(np.uint8).reshape(*SIZE, 3))
        depth.append((hits.depth + rng.normal(0, 5e-4, len(hits.depth))).astype(np.float32).reshape(SIZE))
    stream = ImageStream(time, np.array(rgb), np.array(depth), intrinsics, camera.pose)
    demonstration = Demonstration("demo_0", task=task, image={"camera": stream})
    return Recording(XML, (demonstration,), source="drawn")
