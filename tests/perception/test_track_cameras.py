"""Tracking with several cameras, and with one that moves with the robot."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

import concent_warp as cw
from concent_warp.perception.tracking.geometry.pose import twist_between
from concent_warp.reality.record import RealityCfg
from concent_warp.reality.sensors.camera import record_depth_images
from concent_warp.recording.recording import Channel, ImageStream
from concent_warp.scene.scene import Scene
from tests.perception.grasp_films import CAMERA, RATE, START

OTHER = {"camera_position": (0.9, 0.55, 0.7), "camera_target": (0.47, -0.08, 0.04)}
SHIFT = 0.12
"""How far the carriage moves [m]."""


def states(performed, count: int, first: float = START) -> tuple[np.ndarray, np.ndarray]:
    """Return times (T,) [s] and true states (T, nq) of frames."""
    time = first + np.arange(count) / RATE
    return time, performed[1][0].qpos[np.round(time / RealityCfg().world.timestep).astype(int)]


def taken(performed, time: np.ndarray, qpos: np.ndarray, **camera) -> ImageStream:
    """Return the frames of a camera."""
    cfg, scene = RealityCfg(), Scene(performed[0].scene)
    sensing = replace(CAMERA, object_pattern=False, **camera)
    rng = np.random.default_rng(0)
    return record_depth_images(sensing, cfg.world.build(scene), scene.objects(), time, qpos, rng)


def error(found: cw.BodyTrack, poses: np.ndarray) -> np.ndarray:
    """Return the errors of position [m], shape (T,)."""
    twist = [twist_between(truth, pose) for truth, pose in zip(poses, found.pose, strict=True)]
    return np.linalg.norm(np.array(twist)[:, :3], axis=1)


def variance(found: cw.BodyTrack) -> float:
    """Return the mean variance of a position [m^2], summed over axes."""
    return float(np.trace(found.covariance[:, :3, :3], axis1=1, axis2=2).mean())


def test_two_cameras_are_more_certain_than_one_and_one_takes_over_from_the_other(performed, plain):
    count = 8
    time, qpos = states(performed, count)
    first = plain.recording[0].image["camera"]
    both = {
        "camera": replace(first, time=time, rgb=first.rgb[:count], depth=first.depth[:count]),
        "other": taken(performed, time, qpos, **OTHER),
    }
    poses = plain.poses[:count]
    two = replace(plain.recording, demonstrations=(replace(plain.recording[0], image=both),))
    found = cw.track(two, pose={"block": poses[0]}).track("block")
    alone = cw.track(two, pose={"block": poses[0]}, cameras=["camera"]).track("block")
    assert not found.lost.any()
    assert error(found, poses).mean() < 0.6e-3
    assert variance(found) < variance(alone)
    # The first camera sees nothing in the second half.
    blind = both["camera"].depth.copy()
    blind[count // 2 :] = 0
    half = {**both, "camera": replace(both["camera"], depth=blind, rgb=both["camera"].rgb * (blind[..., None] > 0))}
    taken_over = replace(two, demonstrations=(replace(two[0], image=half),))
    found = cw.track(taken_over, pose={"block": poses[0]}).track("block")
    assert not found.lost.any()
    assert error(found, poses).max() < 2e-3


def test_a_camera_on_a_moving_body_is_followed_by_its_joint(performed):
    count = 8
    time, qpos = states(performed, count, 0.2)  # the block stands still
    shift = SHIFT * np.linspace(0, 1, count)
    frames = [
        taken(
            performed, time[k : k + 1], qpos[k : k + 1],
            camera_position=tuple(np.add(CAMERA.camera_position, [s, 0, 0])),
            camera_target=tuple(np.add(CAMERA.camera_target, [s, 0, 0])), camera_fovy=25.0,
        )
        for k, s in enumerate(shift)
    ]  # fmt: skip
    stream = replace(
        frames[0],
        time=time,
        rgb=np.concatenate([f.rgb for f in frames]),
        depth=np.concatenate([f.depth for f in frames]),
        body="carriage",
    )
    recording = performed[0]
    spec = mujoco.MjSpec.from_string(recording.scene)
    carriage = spec.worldbody.add_body(name="carriage")
    carriage.add_geom(size=[0.01, 0, 0], pos=[0, 0, -1], contype=0, conaffinity=0)
    carriage.add_joint(name="rail", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0])
    spec.add_sensor(
        name="rail", type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname="rail"
    )
    pose = np.eye(4)
    joint = Scene(recording.scene).model.joint("block_joint").qposadr[0]
    pose[:3, 3] = qpos[0, joint : joint + 3]
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, qpos[0, joint + 3 : joint + 7])
    pose[:3, :3] = rotation.reshape(3, 3)
    measured = {**recording[0].measured, "rail": Channel(time, shift[:, None])}
    demonstration = replace(
        recording[0], qpos=None, qvel=None, points={}, measured=measured, image={"camera": stream}
    )  # fmt: skip
    moving = replace(recording, scene=spec.to_xml(), demonstrations=(demonstration,))
    found = cw.track(moving, pose={"block": pose}).track("block")
    assert not found.lost.any()
    assert error(found, np.tile(pose, (count, 1, 1))).max() < 1e-3
    # Taken for fixed, the camera makes the block move.
    still = replace(moving, demonstrations=(replace(demonstration, image={"camera": replace(stream, body=None)}),))
    wrong = cw.track(still, pose={"block": pose}).track("block")
    apart = error(wrong, np.tile(pose, (count, 1, 1)))
    assert wrong.lost[-1] or apart[-1] > 0.5 * SHIFT
