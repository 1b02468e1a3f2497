"""Frames of two blocks of one shape on a table, drawn by ray casting with shading and noise: cheap, no Reality."""

from __future__ import annotations

import numpy as np

import concent_warp as cw
from concent_warp.perception.pinhole import Pinhole, pixel_grid
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.recording.recording import Channel, Demonstration, ImageStream, Recording
from concent_warp.scene.scene import Scene

SCENE = """
<mujoco>
  <worldbody>
    <geom name="table" type="box" size="0.3 0.3 0.02" pos="0 0 -0.02"/>
    <body pos="0.2 0.2 0.05"><joint name="hinge" type="hinge"/><geom type="box" size="0.01 0.01 0.01"/></body>
    <body name="left" pos="0 1 0"><freejoint/><geom type="box" size="0.03 0.02 0.015"/></body>
    <body name="right" pos="0 2 0"><freejoint/><geom type="box" size="0.03 0.02 0.015"/></body>
  </worldbody>
  <sensor><jointpos name="hinge" joint="hinge"/></sensor>
</mujoco>
"""
SHAPE = (120, 160)
PLACES = {"left": (-0.06, 0.02, 0.015), "right": (0.07, -0.01, 0.015)}
"""Where the blocks are at the start [m]."""

TURNS = {"left": 0.4, "right": -0.7}
"""How they are turned about the vertical [rad]."""
POSES = (
    f"[left]\nposition = {list(PLACES['left'])}\n"
    f"quaternion = [{np.cos(TURNS['left'] / 2)}, 0.0, 0.0, {np.sin(TURNS['left'] / 2)}]\n"
)
"""File of the first pose of one."""


def camera() -> Pinhole:
    """Return a camera that looks down at the table from the side, 0.5 m away."""
    eye, forward = np.array([0.0, -0.35, 0.36]), np.array([0.0, 0.35, -0.36])
    forward /= np.linalg.norm(forward)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([[1.0, 0, 0], np.cross(forward, [1.0, 0, 0]), forward], axis=1)
    pose[:3, 3] = eye
    return Pinhole(np.array([[240.0, 0, 79.5], [0, 240, 59.5], [0, 0, 1]]), pose)


def drawn(frames: int) -> tuple[Recording, dict[str, np.ndarray]]:
    """Return a recording in which the blocks slide apart, and their positions, shape (frames, 3)."""
    scene, view, rng = Scene(SCENE), camera(), np.random.default_rng(0)
    renderer = RayRenderer(scene.model)
    pixels = pixel_grid(*SHAPE).reshape(-1, 2)
    rgb, depth = np.zeros((frames, *SHAPE, 3), np.uint8), np.zeros((frames, *SHAPE), np.float32)
    places = {name: np.tile(place, (frames, 1)) for name, place in PLACES.items()}
    for t in range(frames):
        for name, turn in TURNS.items():
            places[name][t, 0] += np.sign(PLACES[name][0]) * 0.001 * t
            pose = np.eye(4)
            pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
            pose[:3, 3] = places[name][t]
            renderer.place(scene.model.body(name).id, pose)
        hits = renderer.cast(view, pixels)
        known = np.isfinite(hits.depth)
        light = np.where(known, 60 + 120 * np.abs(hits.normal @ [0.3, -0.5, 0.8]) + 40 * (hits.body > 1), 20)
        rgb[t] = np.clip(light + rng.normal(0, 2, len(light)), 0, 255).reshape(*SHAPE, 1)
        measured = np.where(known, hits.depth + rng.normal(0, 5e-4, len(light)), 0)
        depth[t] = measured.reshape(SHAPE)
    time = np.arange(frames) / 20
    stream = ImageStream(time, rgb, depth, view.intrinsics, view.pose)
    hinge = Channel(np.array([0.0, 10.0]), np.zeros((2, 1)))
    demonstration = Demonstration("demo_0", measured={"hinge": hinge}, image={"camera": stream})
    return cw.Recording(SCENE, (demonstration,)), places
