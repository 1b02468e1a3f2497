"""What a fit aims at: observed point clouds of each object, cut into segments that are simulated on their own.

The observed clouds V_t (paper, section 3.1.1) are tracked material points. The simulator's prediction of the same
points is V_0, carried in the frame of the body as the simulation moves it. A recording that holds poses instead of
points serves as well: points on the body's surface are then carried by the measured pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from concent_warp.checks import Count
from concent_warp.errors import RecordingError
from concent_warp.estimation.jointed_pose import jointed_pose
from concent_warp.perception.rigid_motion import kabsch
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene
from concent_warp.scene.sensor_frame import SensorFrame, sensor_frame
from concent_warp.simulate.replay import commands, initial_state, step_count


@dataclass(frozen=True)
class ObjectTrackCfg:
    """How observed poses and points become target points."""

    rest_displacement: float = 5e-4
    """Displacement of the mean of a body's points below which the body counts as at rest [m]: of the order of the noise
    of a point tracker, averaged over its points."""
    surface_points: Count = 64
    """Surface points that represent a body whose pose is measured [-]: enough to cover its faces and edges."""


@dataclass(frozen=True)
class BodyTarget:
    """Observed points of one body during one segment."""

    body: str
    anchor: np.ndarray
    """The points in the body frame [m], shape (M, 3)."""
    time: np.ndarray
    """Times from the segment's start [s], shape (T,)."""
    points: np.ndarray
    """Observed positions [m], world frame, shape (T, M, 3); NaN where not seen."""

    def held_out(self, share: float, block: float) -> np.ndarray:
        """Return which frames are kept from the fit, shape (T,) bool: every 1/share-th block of `block` seconds."""
        if share <= 0:
            return np.zeros(len(self.time), dtype=bool)
        number = np.floor(self.time / block).astype(int)
        return number % max(round(1 / share), 2) == 1


@dataclass(frozen=True)
class Segment:
    """A stretch of a demonstration that is simulated from a state of its own."""

    name: str
    qpos: np.ndarray
    """State at the start, shape (nq,)."""
    qvel: np.ndarray
    """Velocity at the start, shape (nv,)."""
    ctrl: np.ndarray
    """Commands, shape (K, nu)."""
    targets: tuple[BodyTarget, ...]
    joints: Mapping[int, Channel] = field(default_factory=dict)
    """Measured joint positions by address in qpos, times from the segment's start."""
    held_out: bool | None = None
    """Whether the whole segment is kept from the fit; None keeps blocks of its frames."""


def whole_demonstration(
    scene: Scene, demonstration: Demonstration, bodies: tuple[str, ...], cfg: ObjectTrackCfg | None = None
) -> Segment:
    """Return a demonstration as one segment, with the bodies of `bodies` that move and were observed as targets."""
    model = scene.model
    steps = step_count(demonstration, model.opt.timestep)
    qpos, qvel = initial_state(model, demonstration)
    movable = [body for body in bodies if model.body(body).weldid[0] != 0]
    targets = [t for body in movable if (t := body_target(scene, demonstration, body, qpos, cfg)) is not None]
    if not targets:
        raise RecordingError(
            "nothing to fit to",
            where=demonstration.name,
            expected=f"points, position and orientation, or all joints, of one of {movable}",
            fix="record /points/<body>, the body's pose, or the positions of the passive joints on which it moves",
        )
    joints = _joint_channels(model, demonstration)
    return Segment(demonstration.name, qpos, qvel, commands(model, demonstration, steps), tuple(targets), joints)


def body_target(
    scene: Scene, demonstration: Demonstration, body: str, qpos: np.ndarray, cfg: ObjectTrackCfg | None = None
) -> BodyTarget | None:
    """Return the observed points of a body: tracked ones, else its surface carried by its measured pose, else None.

    The pose is that of its sensors, or of the sensors of the passive joints on which it moves.
    """
    cfg = cfg or ObjectTrackCfg()
    data = mujoco.MjData(scene.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(scene.model, data)
    origin, rotation = data.body(body).xpos.copy(), data.body(body).xmat.reshape(3, 3).copy()
    if body in demonstration.points:
        track = demonstration.points[body]
        points = np.where(track.visible[:, :, None], track.value, np.nan)
        anchor = (_resting_mean(points, cfg.rest_displacement) - origin) @ rotation
        known = np.isfinite(anchor).all(axis=1)
        return BodyTarget(body, anchor[known], track.time, points[:, known])
    pose = measured_pose(scene.model, demonstration, body) or jointed_pose(scene.model, demonstration, body)
    if pose is None:
        return None
    time, position, turn = pose
    anchor = _surface_points(scene, body, cfg.surface_points)
    return BodyTarget(body, anchor, time, position[:, None] + np.einsum("tij,mj->tmi", turn.as_matrix(), anchor))


def _resting_mean(points: np.ndarray, rest_displacement: float) -> np.ndarray:
    """Return each point's mean over the frames before the body moves [m], shape (M, 3); NaN for points unseen then."""
    centre = np.nanmean(points - points[:1], axis=1)
    moved = np.flatnonzero(np.linalg.norm(centre, axis=1) > rest_displacement)
    frames = max(int(moved[0]) if len(moved) else len(points), 1)
    seen = np.all(np.isfinite(points[:frames]), axis=2)
    total = np.where(seen[:, :, None], points[:frames], 0.0).sum(axis=0)
    with np.errstate(invalid="ignore"):
        return total / np.where(seen.any(axis=0), seen.sum(axis=0), np.nan)[:, None]


def measured_pose(
    model: mujoco.MjModel, demonstration: Demonstration, body: str
) -> tuple[np.ndarray, np.ndarray, Rotation] | None:
    """Return times [s], positions [m] (T, 3) and rotations of a body's frame, from its pose sensors; None without.

    Times are those of the positions. Orientations that were read at other times are interpolated, along the shorter
    way; before the first and after the last one they stay.
    """
    position = frame_channel(model, demonstration, body, mujoco.mjtSensor.mjSENS_FRAMEPOS)
    orientation = frame_channel(model, demonstration, body, mujoco.mjtSensor.mjSENS_FRAMEQUAT)
    if position is None or orientation is None:
        return None
    rotation = _rotations(orientation, position.time)
    return None if rotation is None else (position.time, position.value, rotation)


def frame_channel(
    model: mujoco.MjModel, demonstration: Demonstration, body: str, kind: mujoco.mjtSensor
) -> Channel | None:
    """Return what was measured of a body's frame in the world by a sensor of a kind, or None.

    Sensors of another frame on the body, such as a marker's site, a geom or the centre of mass, and of any in a frame
    that stands in the world, such as a camera's, count where none measures the body's own in the world: orientations
    are turned, and positions moved to the body's origin by the orientations measured at the same time. Velocities are
    those of the same origin in the world only.
    """
    found = _frame_channels(model, demonstration, body, kind)
    for frame, channel in found:
        if frame.is_body:
            return channel
    for frame, channel in found:
        if kind == mujoco.mjtSensor.mjSENS_FRAMEQUAT:
            valid = np.isfinite(channel.value).all(axis=1)
            value = np.full(channel.value.shape, np.nan)
            if valid.any():
                value[valid] = frame.body_in_world(channel.value[valid]).as_quat(scalar_first=True)
            return replace(channel, value=value)
        if kind == mujoco.mjtSensor.mjSENS_FRAMEPOS:
            place = frame.place_in_world(channel.value)
            if not frame.is_beside:
                return replace(channel, value=place)
            turned = frame_channel(model, demonstration, body, mujoco.mjtSensor.mjSENS_FRAMEQUAT)
            if turned is not None and (rotation := _rotations(turned, channel.time)) is not None:
                return replace(channel, value=place - rotation.apply(frame.offset))
        elif not frame.is_beside and replace(frame, turn=Rotation.identity()).is_body:
            return channel
    return None


def _frame_channels(
    model: mujoco.MjModel, demonstration: Demonstration, body: str, kind: mujoco.mjtSensor
) -> list[tuple[SensorFrame, Channel]]:
    """Return the measured channels of sensors of a kind on a body, each with its frame."""
    row, found = model.body(body).id, []
    for name, channel in demonstration.measured.items():
        sensor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
        if sensor < 0 or int(model.sensor_type[sensor]) != int(kind):
            continue
        frame = sensor_frame(model, sensor)
        if frame is not None and frame.body == row:
            found.append((frame, channel))
    return found


def _rotations(orientation: Channel, time: np.ndarray) -> Rotation | None:
    """Return measured orientations at other times (T,) [s], along the shorter way; None where none was measured.

    Before the first and after the last one they stay.
    """
    valid = np.isfinite(orientation.value).all(axis=1)
    if not valid.any():
        return None
    turn, clock = Rotation.from_quat(orientation.value[valid], scalar_first=True), orientation.time[valid]
    if len(clock) == 1:
        turn, clock = Rotation.concatenate([turn, turn]), np.array([clock[0], clock[0] + 1.0])
    return Slerp(clock, turn)(np.clip(time, clock[0], clock[-1]))


def observed_states(model: mujoco.MjModel, segment: Segment, time: np.ndarray, qpos: np.ndarray) -> np.ndarray:
    """Return simulated states with what was observed put in its place, shape (T, nq).

    Free bodies stand where their points were seen, and joints where their encoders read; the rest stays simulated.

    Args:
        model: Compiled scene.
        segment: Holds the observations.
        time: Times of the states [s], shape (T,).
        qpos: Simulated states, shape (T, nq).
    """
    result = qpos.copy()
    for address, channel in segment.joints.items():
        valid = np.isfinite(channel.value[:, 0])
        result[:, address] = np.interp(time, channel.time[valid], channel.value[valid, 0])
    for target in segment.targets:
        joint = model.body(target.body).jntadr[0]
        if joint < 0 or int(model.jnt_type[joint]) != int(mujoco.mjtJoint.mjJNT_FREE):
            continue
        address = model.jnt_qposadr[joint]
        frame = np.abs(target.time[None] - time[:, None]).argmin(axis=1)
        pose = observed_poses(target, frame)
        seen = np.isfinite(pose).all(axis=1)
        result[seen, address : address + 7] = pose[seen]
    return result


def observed_poses(target: BodyTarget, frames: np.ndarray) -> np.ndarray:
    """Return position [m] and quaternion wxyz of a body in some frames (F,), from its points; NaN where fewer than 3.

    Frames in which the same points were seen are solved at once.
    """
    result = np.full((len(frames), 7), np.nan)
    seen = np.isfinite(target.points[frames]).all(axis=2)
    patterns, which = np.unique(seen, axis=0, return_inverse=True)
    for k, pattern in enumerate(patterns):
        rows = np.flatnonzero(which.ravel() == k)
        if pattern.sum() >= 3:
            observed = target.points[frames[rows]][:, pattern]
            transform = kabsch(np.broadcast_to(target.anchor[pattern], observed.shape), observed)
            result[rows, :3] = transform[:, :3, 3]
            result[rows, 3:] = Rotation.from_matrix(transform[:, :3, :3]).as_quat(scalar_first=True)
    return result


def _joint_channels(model: mujoco.MjModel, demonstration: Demonstration) -> dict[int, Channel]:
    """Return the measured joint positions of a demonstration by their address in qpos."""
    result = {}
    for name, channel in demonstration.measured.items():
        sensor = model.sensor(name).id
        if int(model.sensor_type[sensor]) == int(mujoco.mjtSensor.mjSENS_JOINTPOS):
            result[int(model.jnt_qposadr[model.sensor_objid[sensor]])] = channel
    return result


def _surface_points(scene: Scene, body: str, count: int) -> np.ndarray:
    """Return points spread evenly over a body's surface, body frame [m], shape (count, 3)."""
    from concent_warp.scene.shapes.surface import Surface
    from concent_warp.scene.spheres.sampling import farthest_point_sampling

    points, _ = Surface.of_body(scene, body).sample(20 * count, np.random.default_rng(0))
    return points[farthest_point_sampling(points, count)]
