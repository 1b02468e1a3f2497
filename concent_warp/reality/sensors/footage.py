"""Colour images of several cameras in Reality, fixed or on the robot's wrist."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import mujoco
import numpy as np

from concent_warp.checks import Bounds, Pixels, Positive, Rate, Share
from concent_warp.reality.appearance.surroundings import furnish
from concent_warp.recording.recording import ImageStream
from concent_warp.scene.cameras import add_cameras


@dataclass(frozen=True)
class FootageCfg:
    """Settings of colour cameras in Reality."""

    cameras: tuple[str, ...] = ()
    """Cameras whose frames are recorded: base and wrist, or such as the scene has; none by default."""
    size: tuple[Pixels, Pixels] = (256, 256)
    """Height and width of a frame [px]."""
    rate: Rate = 10.0
    """Frame rate [Hz]."""
    objects: bool = True
    """Whether the objects are visible. Frames without them are for training the appearance of robot and background."""
    noise: Annotated[float, Bounds(0, 255)] = 2.0
    """Standard deviation of the colours' noise [1/255]."""
    white_balance: tuple[float, float, float] = (1.10, 1.0, 0.84)
    """Gains of red, green and blue [-]: warmer than the simulated camera."""
    gamma: Positive = 0.85
    """Exponent of the tone curve [-]."""
    vignette: Share = 0.22
    """Share of the light that the corners lose [-]."""
    samples: Annotated[int, Bounds(1, 64)] = 2
    """Colour samples along each edge of a pixel."""


def footage(
    cfg: FootageCfg,
    world: mujoco.MjSpec,
    objects: tuple[str, ...],
    time: np.ndarray,
    qpos: np.ndarray,
    rng: np.random.Generator,
) -> dict[str, ImageStream]:
    """Return the frames of each camera along a motion, without depth.

    Args:
        cfg: The cameras.
        world: Reality.
        objects: Names of the objects' bodies.
        time: Times of the frames [s], shape (T,).
        qpos: States of the world at these times, shape (T, nq).
        rng: Source of the noise.
    """
    import mujoco_warp as mjw
    import warp as wp

    spec = furnish(world, objects, there=cfg.objects)
    add_cameras(spec, objects)
    model = still_world(spec).compile()
    data = mujoco.MjData(model)
    height, width = cfg.size
    rows = [model.camera(name).id for name in cfg.cameras]
    frames = np.zeros((len(rows), len(time), height, width, 3), dtype=np.uint8)
    shade = vignette(height, width, cfg.vignette)[..., None]
    with wp.ScopedDevice("cpu"):
        warp_model, warp_data = mjw.put_model(model), mjw.put_data(model, data)
        context = mjw.create_render_context(
            model, cam_res=(width, height), cam_active=rows, render_rgb=True, render_depth=False, render_seg=False,
            use_shadows=True, samples_per_pixel=cfg.samples,
        )  # fmt: skip
        seen: Any = wp.zeros((1, height, width), dtype=wp.vec3)
        for t, state in enumerate(qpos):
            wp.to_torch(warp_data.qpos)[0] = wp.to_torch(wp.array(state, dtype=float))
            mjw.kinematics(warp_model, warp_data)
            mjw.camlight(warp_model, warp_data)
            mjw.refit_bvh(warp_model, warp_data, context)
            mjw.render(warp_model, warp_data, context)
            for c in range(len(rows)):
                mjw.get_rgb(context, c, seen)
                light = apply_tone_curve(seen.numpy()[0] * shade, cfg)
                frames[c, t] = np.clip(np.round(255 * light + rng.normal(0, cfg.noise, light.shape)), 0, 255)
    return {
        name: ImageStream(
            np.asarray(time, float),
            frames[c],
            np.zeros((len(time), height, width), dtype=np.float32),
            _pinhole_matrix(float(model.cam_fovy[row]), height, width),
            _mounting(model, row),
            None if model.cam_bodyid[row] == 0 else model.body(model.cam_bodyid[row]).name,
        )
        for c, (name, row) in enumerate(zip(cfg.cameras, rows, strict=True))
    }


def apply_tone_curve(light: np.ndarray, cfg: FootageCfg) -> np.ndarray:
    """Return the colours 0..1 that the cameras report for light in 0..1, shape (..., 3)."""
    return np.clip(light * np.array(cfg.white_balance), 0, 1) ** cfg.gamma


def still_world(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Return a world without all that only moves it, which the ray tracer's simulator may not know."""
    for elements in (spec.keys, spec.sensors, spec.actuators, spec.equalities, spec.tendons):
        for element in list(elements):
            spec.delete(element)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.noslip_iterations = 0
    return spec


def vignette(height: int, width: int, loss: float) -> np.ndarray:
    """Return the share of light that arrives at each pixel, shape (height, width)."""
    v, u = np.mgrid[0:height, 0:width]
    squared = ((2 * u / (width - 1) - 1) ** 2 + (2 * v / (height - 1) - 1) ** 2) / 2
    return 1 - loss * squared


def _pinhole_matrix(fovy: float, height: int, width: int) -> np.ndarray:
    """Return the pinhole matrix [px], shape (3, 3), of a vertical field of view [degrees]."""
    focal = height / 2 / np.tan(np.radians(fovy) / 2)
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])


def _mounting(model: mujoco.MjModel, camera: int) -> np.ndarray:
    """Return a camera's pose on its body, shape (4, 4), axes x right, y down, z forward."""
    rotation, pose = np.zeros(9), np.eye(4)
    mujoco.mju_quat2Mat(rotation, model.cam_quat[camera])
    pose[:3, :3] = rotation.reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = model.cam_pos[camera]
    return pose
