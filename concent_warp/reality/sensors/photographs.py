"""Photographs of one object of Reality from all sides, for Gaussian splats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import mujoco
import numpy as np

from concent_warp.checks import Bounds, OpenAngle, Pixels, PositiveShare
from concent_warp.reality.sensors.camera import camera_world
from concent_warp.reality.sensors.sensing import SensingCfg

VISIBLE_GROUP, HIDDEN_GROUP = 0, 5
"""Groups of geoms that the camera sees and does not see."""


@dataclass(frozen=True)
class PhotographsCfg:
    """How an object is photographed."""

    count: Annotated[int, Bounds(1, 100_000)] = 48
    """Photographs, spread over the sphere around the object."""
    size: Pixels = 128
    """Width and height [px]."""
    samples: Annotated[int, Bounds(1, 64)] = 3
    """Rays along each edge of a pixel [-]."""
    fovy: OpenAngle = 20.0
    """Vertical field of view [degrees]."""
    fill: PositiveShare = 0.8
    """Share of the image's height that the object's bounding sphere takes."""
    rgb_std: Annotated[float, Bounds(0, 255)] = 0.0
    """Standard deviation of the colours' noise [1/255]."""
    lowest: Annotated[float, Bounds(-90, 90)] = -90.0
    """Least elevation of the camera [degrees]: -90 also sees the object from below, as where it is turned by hand."""


class Photographs(NamedTuple):
    """V photographs in the frame of the object."""

    rgba: np.ndarray
    """Colours and mask, not premultiplied, uint8, shape (V, H, W, 4)."""
    poses: np.ndarray
    """Camera-to-object transforms of cameras that look along -z, y up [m], shape (V, 4, 4)."""
    intrinsics: np.ndarray
    """Pinhole matrices [px], (0, 0) the centre of the first pixel, shape (V, 3, 3)."""


def photographs(world: mujoco.MjSpec, body: str, cfg: PhotographsCfg | None = None, *, seed: int = 0) -> Photographs:
    """Photograph a body of Reality with its speckle pattern, without other bodies.

    Args:
        world: Reality.
        body: name of the object.
        cfg: how.
        seed: of the noise.
    """
    import mujoco_warp as mjw
    import warp as wp

    cfg = cfg or PhotographsCfg()
    fine = cfg.size * cfg.samples
    spec = camera_world(world, (body,), SensingCfg(image_size=(fine, fine), camera_fovy=cfg.fovy))
    for geom in spec.geoms:
        geom.group = VISIBLE_GROUP if geom.parent.name == body else HIDDEN_GROUP
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    middle, radius = _bounding_sphere(model, data, body)
    distance = radius / np.sin(np.radians(cfg.fovy / 2 * cfg.fill))
    cameras = [_looking_at(middle, middle + distance * side) for side in _directions(cfg)]
    rng = np.random.default_rng(seed)
    images = []
    with wp.ScopedDevice("cpu"):
        warp_model, warp_data = mjw.put_model(model), mjw.put_data(model, data)
        context = mjw.create_render_context(
            model, cam_res=(fine, fine), render_rgb=True, render_depth=True, use_shadows=False,
            enabled_geom_groups=[VISIBLE_GROUP],
        )  # fmt: skip
        seen: Any = wp.zeros((1, fine, fine), dtype=wp.vec3)
        for camera in cameras:
            for name, value in (("cam_xpos", camera[:3, 3]), ("cam_xmat", camera[:3, :3])):
                target = getattr(warp_data, name)
                wp.copy(target, wp.array(value.reshape(target.numpy().shape), dtype=target.dtype))
            mjw.refit_bvh(warp_model, warp_data, context)
            mjw.render(warp_model, warp_data, context)
            mjw.get_rgb(context, 0, seen)
            mask = context.depth_data.numpy()[0].reshape(fine, fine) > 0
            images.append(_exposed(seen.numpy()[0], mask, cfg, rng))
    to_object = np.eye(4)
    to_object[:3, :3] = data.body(body).xmat.reshape(3, 3)
    to_object[:3, 3] = data.body(body).xpos
    focal = cfg.size / 2 / np.tan(np.radians(cfg.fovy / 2))
    centre = (cfg.size - 1) / 2
    matrix = np.array([[focal, 0, centre], [0, focal, centre], [0, 0, 1]])
    poses = np.linalg.inv(to_object) @ np.stack(cameras)
    return Photographs(np.stack(images), poses, np.tile(matrix, (cfg.count, 1, 1)))


def _bounding_sphere(model: mujoco.MjModel, data: mujoco.MjData, body: str) -> tuple[np.ndarray, float]:
    """Return the middle [m], shape (3,), and a radius [m] of what a body's geoms take up."""
    number = model.body(body).id
    geoms = np.flatnonzero(model.geom_bodyid == number)
    corners = []
    for g in geoms:
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        box = model.geom_aabb[g, :3] + signs * model.geom_aabb[g, 3:]
        corners.append(box @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g])
    points = np.concatenate(corners)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return middle, float(np.linalg.norm(points - middle, axis=1).max())


def _directions(cfg: PhotographsCfg) -> np.ndarray:
    """Return unit vectors spread evenly over the sphere above the least elevation, shape (V, 3), in a spiral."""
    k = np.arange(cfg.count) + 0.5
    low = np.sin(np.radians(cfg.lowest))
    z = low + (1 - low) * k / cfg.count
    angle = k * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - z**2)
    return np.stack([level * np.cos(angle), level * np.sin(angle), z], axis=1)


def _looking_at(target: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the pose, shape (4, 4), of an upright camera that looks along -z at a target, y up."""
    backward = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0, 0, 1.0], backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(backward, right), backward], axis=1)
    pose[:3, 3] = position
    return pose


def _exposed(colour: np.ndarray, mask: np.ndarray, cfg: PhotographsCfg, rng: np.random.Generator) -> np.ndarray:
    """Return a photograph, uint8, shape (H, W, 4), of fine colours 0..1 and a mask, samples of a pixel averaged."""
    shape = (cfg.size, cfg.samples, cfg.size, cfg.samples)
    alpha = mask.reshape(shape).mean(axis=(1, 3))
    light = (colour * mask[..., None]).reshape(*shape, 3).mean(axis=(1, 3))
    straight = light / np.maximum(alpha, 1e-6)[..., None]
    level = 255 * straight + rng.normal(0, 1, straight.shape) * cfg.rgb_std
    return np.round(np.clip(np.dstack([level, 255 * alpha]), 0, 255)).astype(np.uint8)
