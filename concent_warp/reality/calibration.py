"""Recordings for camera calibration in Reality: the arm before a tag, or with a tag on its hand, or alone.

The recording knows the robot and the table, not the tag, and the camera only roughly; its clocks differ. Frames are
taken at twice the resolution, at two instants of the exposure, and averaged: edges are as soft as those of a lens.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import mujoco
import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from concent_warp.checks import Bounds, Count, Duration, OpenAngle, Pixels, Positive, PositiveDuration, Signed
from concent_warp.errors import SceneError
from concent_warp.reality.appearance.printed import add_plate, charuco_print, tag_print
from concent_warp.reality.expert.inverse_kinematics import solve_path
from concent_warp.reality.sensors.camera import noisy_depth
from concent_warp.reality.sensors.instruments import Instruments
from concent_warp.reality.sensors.sensing import SensingCfg
from concent_warp.recording.recording import Channel, Demonstration, ImageStream, Recording
from concent_warp.scene.cameras import add_camera
from concent_warp.scene.robot import panda
from concent_warp.scene.scene import Scene
from concent_warp.scene.shape_sorter import home

CAMERA, AIM = "camera", "aim"
"""Names of the camera, and of the site that is brought to sampled poses."""
FLIP = np.diag([1.0, -1.0, -1.0])
"""From the axes of MuJoCo's cameras, which look along -z, to those of recordings."""


@dataclass(frozen=True)
class CalibrationSceneCfg:
    """Settings of recordings for camera calibration in Reality."""

    camera: Literal["hand", "world"] = "hand"
    """What carries the camera; the target is on the other one."""
    target: Literal["tag", "tags", "charuco", "none"] = "tag"
    """One tag, three tags at places of their own, a ChArUco board, or nothing but the robot itself."""
    dictionary: str = "DICT_APRILTAG_36h11"
    """Dictionary of the tags, a name in `cv2.aruco`."""
    tag_size: Positive = 0.06
    """Edge of a tag's black square [m]; of a ChArUco board the edge of a square is 0.03."""
    views: Count = 12
    """Poses that the arm passes through."""
    frames: Count = 24
    """Frames of the camera."""
    duration: PositiveDuration = 24.0
    """Duration of the recording [s]."""
    one_axis: bool = False
    """Whether the hand turns about the vertical only, which does not determine a camera's pose."""
    image_size: tuple[Pixels, Pixels] = (480, 640)
    """Height and width of the frames [px]."""
    fovy: OpenAngle = 46.0
    """Vertical field of view [degrees]."""
    position_error: Duration = 0.03
    """Half width of the error of the recorded camera position by axis [m]."""
    angle_error: Duration = 4.0
    """Half width of the error of the recorded camera orientation by axis [degrees]."""
    offset_range: Duration = 0.06
    """Half width of the offset between the clocks of camera and robot [s]."""
    exposure: Duration = 0.006
    """Exposure of a frame [s]."""
    depth_scale: Positive = 1.0
    """Reported over true depth [-]."""
    focal_scale: Positive = 1.0
    """Recorded over true focal length [-]."""
    joint_bias: Signed = 0.0
    """Standard deviation of a constant error of each encoder [rad]."""
    lost_readings: Annotated[float, Bounds(0, 0.9)] = 0.02
    """Share of the encoders' readings that are missing [-]."""
    sensing: SensingCfg = field(default_factory=SensingCfg)
    """Noise of colours and depth."""
    instruments: Instruments = field(default_factory=Instruments)
    """Encoders."""


@dataclass(frozen=True)
class CalibrationTruth:
    """What the calibration of a recording should find."""

    pose: np.ndarray
    """Camera to world, or to the hand, shape (4, 4)."""
    clock_offset: float
    """Time to be added to the times of frames, so that they are those of the encoders [s]."""
    intrinsics: np.ndarray
    """Pinhole matrix [px], shape (3, 3)."""
    targets: dict[str, np.ndarray]
    """Poses of the prints in the frame of what carries them, shape (4, 4) each."""


def record_calibration(
    cfg: CalibrationSceneCfg, seed: int, *, progress: Callable[[float], None] | None = None
) -> tuple[Recording, CalibrationTruth]:
    """Return a recording for a camera calibration, and its truth; all that varies is sampled from the seed.

    `progress` is called with the share done, 0..1.

    Raises:
        SceneError: No poses are found that the arm can reach.
    """
    rng = np.random.default_rng(seed)
    scene = nominal_scene()
    body = "hand" if cfg.camera == "hand" else None
    pose = _camera_pose(cfg, rng)
    targets = _target_poses(cfg, rng)
    angles = _waypoints(cfg, scene, pose, targets, rng)
    path = PchipInterpolator(np.linspace(0, cfg.duration, len(angles)), angles, axis=0)
    offset = float(rng.uniform(-1, 1) * cfg.offset_range)
    time = np.sort(rng.uniform(0.5, cfg.duration - 0.5, cfg.frames))
    time = 0.5 * time + 0.5 * np.linspace(0.5, cfg.duration - 0.5, cfg.frames)
    rgb, depth = _photograph(cfg, _furnished(cfg, scene, pose, targets), path, time, rng, progress)
    measured = _encoders(cfg, scene, path, rng)
    wrong = np.eye(4)
    wrong[:3, :3] = Rotation.from_rotvec(np.radians(cfg.angle_error) * rng.uniform(-1, 1, 3)).as_matrix()
    wrong[:3, 3] = cfg.position_error * rng.uniform(-1, 1, 3)
    recorded = pose.copy()
    recorded[:3, :3] = wrong[:3, :3] @ pose[:3, :3]
    recorded[:3, 3] += wrong[:3, 3]
    intrinsics = pinhole_matrix(cfg)
    told = intrinsics.copy()
    told[[0, 1], [0, 1]] *= cfg.focal_scale
    image = {CAMERA: ImageStream(time - offset, rgb, depth, told, recorded, body)}
    demonstration = Demonstration("demo_0", "calibrate the camera", measured=measured, image=image)
    recording = Recording(scene.xml, (demonstration,), source="reality")
    return recording, CalibrationTruth(pose, offset, intrinsics, {k: p for k, (p, _, _) in targets.items()})


def nominal_scene() -> Scene:
    """Return the arm at a table, as the recordings know it."""
    spec = panda()
    spec.modelname = "calibration"
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0.4, 0, -0.02],
        size=[0.6, 0.6, 0.02],
        rgba=[0.6, 0.5, 0.4, 1],
    )
    spec.worldbody.add_light(pos=[0.6, -0.4, 1.6], dir=[-0.1, 0.3, -1.0], castshadow=False)
    spec.worldbody.add_light(pos=[0.3, 0.6, 1.4], dir=[0.1, -0.4, -1.0], castshadow=False, diffuse=[0.4] * 3)
    return Scene.from_spec(spec, "calibration")


def pinhole_matrix(cfg: CalibrationSceneCfg) -> np.ndarray:
    """Return the true pinhole matrix [px], shape (3, 3)."""
    height, width = cfg.image_size
    focal = height / 2 / np.tan(np.radians(cfg.fovy) / 2)
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])


def looking(
    position: np.ndarray, target: np.ndarray, roll: float = 0.0, up: tuple[float, ...] = (0, 0, 1)
) -> np.ndarray:
    """Return the pose of a camera at a place that looks at another one, turned about its axis [rad], shape (4, 4)."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec([0, 0, roll]).as_matrix()
    pose[:3, 3] = position
    return pose


def _camera_pose(cfg: CalibrationSceneCfg, rng: np.random.Generator) -> np.ndarray:
    """Return the true pose of the camera in the frame of what carries it, shape (4, 4)."""
    spread = rng.uniform(-1, 1, 3)
    if cfg.camera == "hand":
        return looking(
            np.array([0.07, 0, 0.01]) + 0.01 * spread, np.array([0.03, 0.02 * spread[1], 0.3]), 0.1, (1, 0, 0)
        )
    aim = np.array([0.45, 0.0, 0.25]) if cfg.target != "none" else np.array([0.3, 0.0, 0.4])
    return looking(np.array([1.05, -0.35, 0.65]) + 0.08 * spread, aim + 0.05 * spread[::-1])


def _target_poses(
    cfg: CalibrationSceneCfg, rng: np.random.Generator
) -> dict[str, tuple[np.ndarray, np.ndarray, tuple[float, float]]]:
    """Return pose (4, 4), print and size [m] of each plate, by name, in the frame of what carries it."""
    if cfg.target == "none":
        return {}
    base = np.eye(4)
    if cfg.camera == "hand":
        base[:3, :3] = Rotation.from_euler("ZYX", [rng.uniform(-3, 3), *rng.uniform(-0.1, 0.1, 2)]).as_matrix()
        base[:3, 3] = [0.48 + rng.uniform(-0.05, 0.05), rng.uniform(-0.1, 0.1), 0.03]
    else:
        base[:3, :3] = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0.0]])
        base[:3, :3] = base[:3, :3] @ Rotation.from_rotvec([*rng.uniform(-0.1, 0.1, 2), rng.uniform(-3, 3)]).as_matrix()
        base[:3, 3] = [0.035, rng.uniform(-0.02, 0.02), 0.035]
    if cfg.target == "charuco":
        picture, ratio = charuco_print(cfg.dictionary, 6, 4, 0.75)
        return {"board": (base, picture, (0.18, 0.18 * ratio))}
    places = [np.zeros(3)] if cfg.target == "tag" else [np.zeros(3), np.array([0.11, 0, 0]), np.array([0, 0.12, 0])]
    plates = {}
    for number, place in enumerate(places):
        picture, share = tag_print(cfg.dictionary, 3 + number)
        plate = base.copy()
        plate[:3, 3] += base[:3, :3] @ place
        plate[:3, :3] = plate[:3, :3] @ Rotation.from_rotvec([0, 0, 1.1 * number]).as_matrix()
        plates[f"tag{3 + number}"] = (plate, picture, (cfg.tag_size * share,) * 2)
    return plates


def _waypoints(
    cfg: CalibrationSceneCfg, scene: Scene, pose: np.ndarray, targets: dict[str, Any], rng: np.random.Generator
) -> np.ndarray:
    """Return joint angles of the arm that it passes through [rad], shape (views, 7)."""
    start = home(scene.model)
    if not targets:
        return start[:7] + rng.uniform(-0.45, 0.45, (cfg.views, 7))
    target = next(iter(targets.values()))[0]
    spec = scene.spec()
    quaternion = np.zeros(4)
    aim = pose if cfg.camera == "hand" else target
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(aim[:3, :3]).ravel())
    spec.body("hand").add_site(name=AIM, pos=list(aim[:3, 3]), quat=list(quaternion))
    model = spec.compile()
    found: list[np.ndarray] = []
    yaw0 = 0.0
    for _ in range(60 * cfg.views):
        if len(found) == cfg.views:
            break
        wanted = _view_of(target, cfg, rng, yaw0) if cfg.camera == "hand" else _shown_to(pose, cfg, rng)
        try:
            solved = solve_path(model, AIM, list(range(7)), start, wanted[None, :3, 3], wanted[None, :3, :3])
        except SceneError:
            yaw0 = float(rng.uniform(-np.pi, np.pi)) if cfg.one_axis and not found else yaw0
            continue
        found.append(solved[0])
    if len(found) < cfg.views:
        raise SceneError("the arm reaches too few poses", expected=f"{cfg.views} poses", found=len(found))
    # In an order in which the arm moves little from one pose to the next.
    order, rest = [found.pop(0)], found
    while rest:
        near = int(np.argmin([np.linalg.norm(order[-1] - one) for one in rest]))
        order.append(rest.pop(near))
    return np.array(order)


def _view_of(target: np.ndarray, cfg: CalibrationSceneCfg, rng: np.random.Generator, yaw: float) -> np.ndarray:
    """Return a pose of the camera from which it sees a target, world frame, shape (4, 4)."""
    distance, tilt, around = rng.uniform(0.24, 0.42), np.radians(rng.uniform(5, 45)), rng.uniform(-np.pi, np.pi)
    if cfg.one_axis:
        distance, tilt, around = 0.33, 1e-3, yaw
    direction = np.array([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), np.cos(tilt)])
    aside = 0.0 if cfg.one_axis else 0.03
    position = target[:3, 3] + distance * direction + rng.uniform(-aside, aside, 3)
    roll = yaw + rng.uniform(-0.7, 0.7)
    return looking(position, target[:3, 3] + rng.uniform(-aside, aside, 3), roll, up=(1, 0, 0))


def _shown_to(camera: np.ndarray, cfg: CalibrationSceneCfg, rng: np.random.Generator) -> np.ndarray:
    """Return a pose of a target at which a camera sees it, world frame, shape (4, 4)."""
    place = camera[:3, :3] @ np.array([*rng.uniform(-0.14, 0.14, 2), rng.uniform(0.5, 0.85)]) + camera[:3, 3]
    tilt = np.zeros(3) if cfg.one_axis else rng.uniform(-0.65, 0.65, 3)
    facing = camera[:3, :3] @ FLIP @ Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)]).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(tilt).as_matrix() @ facing
    pose[:3, 3] = place
    return pose


def _furnished(cfg: CalibrationSceneCfg, scene: Scene, pose: np.ndarray, targets: dict[str, Any]) -> mujoco.MjModel:
    """Return the world with camera and prints, and without all that only moves it."""
    spec = scene.spec()
    carrier = "world" if cfg.camera == "hand" else "hand"
    for name, (place, picture, size) in targets.items():
        add_plate(spec, carrier, name, place, picture, size)
    body = spec.body("hand") if cfg.camera == "hand" else spec.worldbody
    ahead = pose[:3, 3] + pose[:3, 2]
    add_camera(body, CAMERA, pose[:3, 3], ahead, -pose[:3, 1], cfg.fovy)
    for elements in (spec.keys, spec.sensors, spec.actuators, spec.equalities, spec.tendons):
        for element in list(elements):
            spec.delete(element)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    return spec.compile()


def _photograph(
    cfg: CalibrationSceneCfg,
    model: mujoco.MjModel,
    path: PchipInterpolator,
    time: np.ndarray,
    rng: np.random.Generator,
    progress: Callable[[float], None] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return colours (T, H, W, 3) uint8 and depths (T, H, W) [m] of the frames taken at times (T,) [s]."""
    import mujoco_warp as mjw
    import warp as wp

    (height, width), data = cfg.image_size, mujoco.MjData(model)
    rgb = np.zeros((len(time), height, width, 3), dtype=np.uint8)
    depth = np.zeros((len(time), height, width), dtype=np.float32)
    with wp.ScopedDevice("cpu"):
        warp_model, warp_data = mjw.put_model(model), mjw.put_data(model, data)
        fine = {"cam_res": (2 * width, 2 * height), "cam_active": [CAMERA], "use_shadows": False}
        colour = mjw.create_render_context(model, render_rgb=True, render_depth=False, **fine)
        ranging = mjw.create_render_context(
            model, render_rgb=False, render_depth=True, **{**fine, "cam_res": (width, height)}
        )
        seen: Any = wp.zeros((1, 2 * height, 2 * width), dtype=wp.vec3)
        for t, instant in enumerate(time):
            light = np.zeros((2 * height, 2 * width, 3))
            for moment in (-0.5, 0.5, 0.0) if cfg.exposure else (0.0,):
                data.qpos[:7] = path(instant + moment * cfg.exposure)
                mujoco.mj_kinematics(model, data)
                mujoco.mj_camlight(model, data)
                for name in ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir"):
                    place = getattr(warp_data, name)
                    wp.copy(place, wp.array(getattr(data, name)[None].reshape(place.numpy().shape), dtype=place.dtype))
                if moment == 0.0 and cfg.exposure:
                    break
                mjw.refit_bvh(warp_model, warp_data, colour)
                mjw.render(warp_model, warp_data, colour)
                mjw.get_rgb(colour, 0, seen)
                light += seen.numpy()[0]
            light = gaussian_filter(light / (2 if cfg.exposure else 1), (1.0, 1.0, 0))
            level = 255 * light.reshape(height, 2, width, 2, 3).mean(axis=(1, 3))
            level = 20 + 0.8 * level + rng.normal(0, cfg.sensing.rgb_std, level.shape)
            rgb[t] = np.clip(np.round(level), 0, 255)
            mjw.refit_bvh(warp_model, warp_data, ranging)
            mjw.render(warp_model, warp_data, ranging)
            exact = ranging.depth_data.numpy()[0].reshape(height, width)
            depth[t] = noisy_depth(cfg.depth_scale * exact, cfg.sensing, rng)
            if progress is not None:
                progress((t + 1) / len(time))
    return rgb, depth


def _encoders(
    cfg: CalibrationSceneCfg, scene: Scene, path: PchipInterpolator, rng: np.random.Generator
) -> dict[str, Channel]:
    """Return what the encoders of the arm read, by sensor."""
    channels = {}
    for joint in range(7):
        instrument = cfg.instruments.angle
        time = instrument.times(cfg.duration, rng)
        time = time[np.concatenate([[True], np.diff(time) > 1e-6])]
        value = path(time)[:, joint : joint + 1] + instrument.noise(time, 1, rng) + rng.normal(0, 1) * cfg.joint_bias
        value[rng.random(len(time)) < cfg.lost_readings] = np.nan
        channels[f"joint{joint + 1}_position"] = Channel(time, value, instrument.std)
    assert set(channels) <= {scene.model.sensor(i).name for i in range(scene.model.nsensor)}
    return channels
