"""Short videos of the grasp in Reality, small enough to render in seconds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.reality.record import RealityCfg
from concent_warp.reality.sensors.camera import record_depth_images
from concent_warp.reality.sensors.sensing import SensingCfg
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene

START, STOP, RATE = 2.3, 2.9, 20.0
"""Span in which the block is grasped and lifted [s], and the camera's rate [Hz]."""
CAMERA = SensingCfg(image_size=(180, 240), camera_fovy=12.0, rgb_blur=0.7, depth_correlation=0.8, disparity_step=0.0014)


@dataclass(frozen=True)
class Film:
    """A video and the truth."""

    recording: Recording
    poses: np.ndarray
    """True poses of the block, shape (T, 4, 4)."""


def filmed(performed, pattern: bool) -> Film:
    recording, truths = performed
    cfg, scene = RealityCfg(), Scene(recording.scene)
    time = np.arange(START, STOP, 1 / RATE)
    qpos = truths[0].qpos[np.round(time / cfg.world.timestep).astype(int)]
    sensing = replace(CAMERA, object_pattern=pattern)
    rng = np.random.default_rng(0)
    stream = record_depth_images(sensing, cfg.world.build(scene), scene.objects(), time, qpos, rng)
    renderer, poses = RayRenderer(scene.model), []
    for state in qpos:
        renderer.set_state(state)
        poses.append(renderer.pose(scene.model.body("block").id))
    demonstration = replace(recording[0], points={}, image={"camera": stream})
    return Film(replace(recording, demonstrations=(demonstration,)), np.array(poses))
