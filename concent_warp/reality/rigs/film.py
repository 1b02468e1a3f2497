"""Rigs before a camera: recordings in which the object is seen, not measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from concent_warp.reality.rigs.rig import Rig, TrueMotion, perform, sensor_channels
from concent_warp.reality.sensors.camera import CAMERA, record_depth_images
from concent_warp.reality.sensors.sensing import SensingCfg
from concent_warp.reality.world import HiddenEffect
from concent_warp.recording.recording import Channel, Demonstration, Recording

FOVY = 42.0
"""Vertical field of view of the camera [degrees], that of a usual depth camera's colour."""
DIRECTION = (0.85, -0.4, 0.4)
"""From the middle of the motion to the camera."""
MIN_DISTANCE = 0.5
"""Least distance from there to the camera [m]."""
MARGIN = 0.1
"""Space around the object's middle that stays in view [m]."""


def film_rig(
    rig: Rig,
    effects: Sequence[HiddenEffect],
    demonstrations: int,
    seed: int,
    sensing: SensingCfg,
    rate: float,
) -> tuple[Recording, list[np.ndarray]]:
    """Return a recording of a rig with one fixed camera's video and joint readings, and the object's true poses.

    Args:
        rig: The experiment, with a `plan` and a free body.
        effects: Hidden effects; those of its instruments act on joint readings alone.
        demonstrations: Number of demonstrations, each of `rig.throws` motions; the motions are those of `record_rig`.
        seed: Seed of motions and noise.
        sensing: The camera; where it stands is chosen here, as near as the whole motion is in view.
        rate: Frames a second [Hz].

    Returns:
        The recording, whose initial states are not known, and for each of its demonstrations the poses in the frames,
        shape (T, 4, 4).
    """
    world = rig.world(effects)
    model = world.compile()
    taken: list[tuple[Demonstration, TrueMotion, np.ndarray]] = []
    for k in range(demonstrations * rig.throws):
        rng = np.random.default_rng([seed, k])
        trial = rig.plan(rng, k)
        motion, _, _ = perform(model, trial, effects, rig.physics)
        measured = sensor_channels(rig, model, motion, effects, rng)
        seen = {name: channel for name, channel in measured.items() if not _of_free_body(model, name)}
        action = {name: Channel(time, value) for name, (time, value) in trial.action.items()}
        at = np.arange(rng.uniform(0, 1 / rate), motion.time[-1], 1 / rate)
        rows = np.round(at / model.opt.timestep).astype(int)
        demonstration = Demonstration(f"demo_{k}", rig.name, action=action, measured=seen)
        taken.append((demonstration, motion, rows))
    truths = [_poses(model, rig.body, motion.qpos[rows]) for _, motion, rows in taken]
    sensing = aimed(sensing, np.concatenate([poses[:, :3, 3] for poses in truths]))
    filmed = []
    for k, (demonstration, motion, rows) in enumerate(taken):
        rng = np.random.default_rng([seed, k, 1])
        states = motion.qpos[rows]
        stream = record_depth_images(sensing, world, (rig.body,), motion.time[rows], states, rng)
        filmed.append(replace(demonstration, image={CAMERA: stream}))
    return Recording(rig.scene.xml, tuple(filmed), source=f"filmed rig {rig.name}"), truths


def aimed(sensing: SensingCfg, points: np.ndarray) -> SensingCfg:
    """Return the camera as near to points (n, 3) [m], in world frame, as all of them are in view with a margin."""
    low, high = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
    middle, direction = (low + high) / 2, np.array(DIRECTION) / np.linalg.norm(DIRECTION)
    height, width = sensing.image_size
    for distance in np.arange(MIN_DISTANCE, 20.0, 0.05):
        x, y, z = (float(v) for v in middle + distance * direction)
        target = (float(middle[0]), float(middle[1]), float(middle[2]))
        placed = replace(sensing, camera_position=(x, y, z), camera_target=target, camera_fovy=FOVY)
        pixels, depth = placed.pinhole().project(corners)
        if (depth > 0).all() and (pixels >= 0).all() and (pixels <= (width - 1, height - 1)).all():
            return placed
    raise ValueError("the motion does not fit into any view within 20 m")


def _of_free_body(model: mujoco.MjModel, sensor: str) -> bool:
    """Return whether a sensor reads the pose or motion of a body with a free joint."""
    row = model.sensor(sensor).id
    if model.sensor_objtype[row] not in (mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY):
        return False
    joint = int(model.body_jntadr[model.sensor_objid[row]])
    return joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE


def _poses(model: mujoco.MjModel, body: str, states: np.ndarray) -> np.ndarray:
    """Return the poses, shape (T, 4, 4), of a body in states, shape (T, nq)."""
    data = mujoco.MjData(model)
    poses = np.repeat(np.eye(4)[None], len(states), axis=0)
    for pose, state in zip(poses, states, strict=True):
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        pose[:3, :3] = data.body(body).xmat.reshape(3, 3)
        pose[:3, 3] = data.body(body).xpos
    return poses
