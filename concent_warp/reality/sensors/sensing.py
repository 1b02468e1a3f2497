"""Sensors of Reality: encoders, a pose tracker, and surface points tracked by a camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import mujoco
import numpy as np

from concent_warp.checks import Bounds, OpenAngle, Pixels, PositiveDuration, Rate, Share, Signed
from concent_warp.perception.pinhole import Pinhole
from concent_warp.perception.rays import cast_rays
from concent_warp.recording.recording import Channel
from concent_warp.scene.scene import Scene


@dataclass(frozen=True)
class SensingCfg:
    """Noise and rates of the instruments."""

    encoder_std: float = 2e-4
    """Joint encoder noise [rad], gripper [m]."""
    encoder_rate: Rate = 100.0
    """Rate of joint readings [Hz]."""
    position_std: float = 3e-4
    """Noise of tracked positions [m]."""
    orientation_std: float = 3e-3
    """Noise of tracked orientations [rad]."""
    pose_rate: Rate = 60.0
    """Rate of tracked poses [Hz]."""
    point_std: float = 1e-3
    """Noise of each tracked surface point [m]."""
    point_rate: Rate = 30.0
    """Rate of the point tracks, that is of the camera [Hz]."""
    visibility_slack: float = 2e-3
    """Distance of a surface in front of a point below which the point counts as visible [m]: larger than rounding of
    sampled surface points, smaller than objects."""
    point_count: Annotated[int, Bounds(1, 100_000)] = 96
    """Points tracked on each object."""
    camera_position: tuple[Signed, Signed, Signed] = (1.05, -0.45, 0.65)
    """Position of the camera [m]."""
    camera_target: tuple[Signed, Signed, Signed] = (0.48, -0.02, 0.02)
    """Point at which the camera is aimed [m]."""
    camera_fovy: OpenAngle = 20.0
    """Vertical field of view of the camera [degrees]."""
    images: bool = False
    """Whether the camera's RGB-D frames are recorded, besides the points tracked in them."""
    image_rate: Rate = 10.0
    """Rate of the recorded frames [Hz]."""
    image_size: tuple[Pixels, Pixels] = (96, 128)
    """Height and width of the frames [px]."""
    image_samples: Annotated[int, Bounds(1, 64)] = 2
    """Colour samples along each edge of a pixel [-]."""
    rgb_std: Annotated[float, Bounds(0, 255)] = 2.0
    """Standard deviation of the colours' noise [1/255]."""
    depth_noise: float = 1.425e-3
    """Depth noise per squared depth [1/m]: std = depth_noise * z^2, 1.3 mm at 0.95 m. The figure of a structured-light
    camera: Khoshelham and Oude Elberink, "Accuracy and resolution of Kinect depth data", Sensors 12(2), 2012."""
    depth_step: float = 2.0**-12
    """Step in which depth is reported [m], 0.24 mm."""
    depth_jump: float = 0.01
    """Difference of depth between neighbouring pixels from which on they lie on an edge [m]."""
    depth_dropout: Share = 0.5
    """Share of the pixels on an edge that have no depth [-]: half of what they cover is hidden from the second eye."""
    object_pattern: bool = True
    """Whether the objects carry a speckle pattern; without it they have one colour each."""
    rgb_blur: Annotated[float, Bounds(0, 100)] = 0.0
    """Standard deviation of the lens' blur [px], off by default."""
    depth_correlation: Annotated[float, Bounds(0, 100)] = 0.0
    """Standard deviation of the window over which depth noise is averaged and so correlated [px]; its size stays that
    of `depth_noise`. Off by default; stereo matching has one to three pixels."""
    disparity_step: Annotated[float, Bounds(0, 10)] = 0.0
    """Step in which inverse depth is reported, besides `depth_step` [1/m]; off by default. It is the step of disparity
    over focal length and baseline: 1/8 px, 600 px and 75 mm give 0.0028 1/m, 2.5 mm at 0.95 m."""
    tracking_std: float = 1e-4
    """Slow deviation of the joints from their commands that no encoder measures [rad]."""
    tracking_time: PositiveDuration = 0.3
    """Correlation time of this deviation [s]."""

    def pinhole(self) -> Pinhole:
        """Return the camera as calibrated: upright, its principal point in the middle of the image."""
        height, width = self.image_size
        focal = height / 2 / np.tan(np.radians(self.camera_fovy) / 2)
        intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
        forward = np.array(self.camera_target) - self.camera_position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = self.camera_position
        return Pinhole(intrinsics, pose)


def _noisy_quaternion(quaternion: np.ndarray, std: float, rng: np.random.Generator) -> np.ndarray:
    """Rotate quaternions (T, 4) by random rotation vectors of `std` [rad] per axis."""
    noise = rng.normal(0, std, (len(quaternion), 3))
    result = np.empty_like(quaternion)
    for i, (q, vector) in enumerate(zip(quaternion, noise, strict=True)):
        result[i] = q
        mujoco.mju_quatIntegrate(result[i], vector, 1.0)
    return result


def _surface_points(scene: Scene, body: str, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return points on the boxes and cylinders of a body, body frame [m], shape (count, 3), by area."""
    import trimesh

    model = scene.model
    parts = []
    for g in np.flatnonzero(model.geom_bodyid == model.body(body).id):
        size = model.geom_size[g]
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX:
            solid = trimesh.creation.box(extents=2 * size)
        elif model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CYLINDER:
            solid = trimesh.creation.cylinder(size[0], 2 * size[1], sections=64)
        else:
            raise ValueError(f"surface points of geom {model.geom(g).name!r}: only boxes and cylinders are supported")
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[g])
        transform = np.eye(4)
        transform[:3, :3], transform[:3, 3] = rotation.reshape(3, 3), model.geom_pos[g]
        parts.append(solid.apply_transform(transform))
    mesh = trimesh.util.concatenate(parts)
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=int(rng.integers(2**31)))[0])


def are_visible(
    sensing: SensingCfg, model: mujoco.MjModel, data: mujoco.MjData, points: np.ndarray, slack: float
) -> np.ndarray:
    """Return which world points (M, 3) [m] the camera sees.

    They lie within the image, and no geom is more than `slack` [m] before them.
    """
    camera = sensing.pinhole()
    pixel, depth = camera.project(points)
    height, width = sensing.image_size
    inside = (depth > 0) & (np.abs(pixel + 0.5 - np.array([width, height]) / 2) < np.array([width, height]) / 2).all(1)
    ray = points - camera.position
    distance = np.linalg.norm(ray, axis=1)
    hit = cast_rays(model, data, camera.position, ray / distance[:, None])
    return inside & ((hit < 0) | (hit > distance - slack))


def visible_points(
    scene: Scene,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    body: str,
    sensing: SensingCfg,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return surface points of a body that the camera sees at time 0, body frame [m], shape (point_count, 3)."""
    local = _surface_points(scene, body, 40 * sensing.point_count, rng)
    place = data.body(body)
    points = place.xpos + local @ place.xmat.reshape(3, 3).T
    local = local[are_visible(sensing, model, data, points, sensing.visibility_slack)]
    return local[rng.choice(len(local), sensing.point_count, replace=False)]


def measure(
    sensing: SensingCfg, model: mujoco.MjModel, time: np.ndarray, readings: np.ndarray, rng: np.random.Generator
) -> dict[str, Channel]:
    """Return every sensor's readings with the noise and the rate of its instrument.

    Args:
        sensing: The instruments.
        model: The world.
        time: Times of the steps [s], shape (T,).
        readings: What perfect sensors read at each step, shape (T, nsensordata).
        rng: Source of the noise.
    """
    channels = {}
    for i in range(model.nsensor):
        name, address, dim = model.sensor(i).name, model.sensor_adr[i], model.sensor_dim[i]
        joint = int(model.sensor_type[i]) in (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_TENDONPOS)
        rate = sensing.encoder_rate if joint else sensing.pose_rate
        rows = reading_steps(time, rate)
        value = readings[rows, address : address + dim]
        if model.sensor_type[i] == mujoco.mjtSensor.mjSENS_FRAMEQUAT:
            std = sensing.orientation_std
            value = _noisy_quaternion(value, std, rng)
        else:
            std = sensing.encoder_std if joint else sensing.position_std
            value = value + rng.normal(0, std, value.shape)
        channels[name] = Channel(time[rows], value, noise_std=std)
    return channels


def reading_steps(time: np.ndarray, rate: float) -> np.ndarray:
    """Return the steps, at times (T,) [s] and evenly spaced, that an instrument with a rate [Hz] reads."""
    return np.unique(np.round(np.arange(0, time[-1], 1 / rate) / (time[1] - time[0])).astype(int))
