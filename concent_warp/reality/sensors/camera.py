"""Depth camera of Reality: frames of MuJoCo-Warp's ray tracer with sensor noise."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from scipy.ndimage import gaussian_filter

from concent_warp.reality.appearance.speckle import dress
from concent_warp.reality.sensors.sensing import SensingCfg
from concent_warp.recording.recording import ImageStream

CAMERA = "camera"
"""Name of the camera in a recording."""


def record_depth_images(
    sensing: SensingCfg,
    world: mujoco.MjSpec,
    bodies: tuple[str, ...],
    time: np.ndarray,
    qpos: np.ndarray,
    rng: np.random.Generator,
) -> ImageStream:
    """Return the frames that the camera takes of a motion.

    Args:
        sensing: The camera.
        world: Reality.
        bodies: Bodies that carry a pattern, unless `sensing` says otherwise.
        time: Times of the frames [s], shape (T,).
        qpos: States of the world at these times, shape (T, nq).
        rng: Source of the noise.
    """
    import mujoco_warp as mjw
    import warp as wp

    height, width = sensing.image_size
    camera = sensing.pinhole()
    model = camera_world(world, bodies, sensing).compile()
    data = mujoco.MjData(model)
    rgb = np.zeros((len(time), height, width, 3), dtype=np.uint8)
    depth = np.zeros((len(time), height, width), dtype=np.float32)
    with wp.ScopedDevice("cpu"):
        warp_model, warp_data = mjw.put_model(model), mjw.put_data(model, data)
        options = {"cam_res": (width, height), "cam_active": [CAMERA], "use_shadows": True}
        # Two contexts, because with several samples a pixel depth is that of the first sample, not of the middle.
        colour = mjw.create_render_context(
            model, render_rgb=True, render_depth=False, samples_per_pixel=sensing.image_samples, **options
        )
        ranging = mjw.create_render_context(model, render_rgb=False, render_depth=True, **options)
        seen: Any = wp.zeros((1, height, width), dtype=wp.vec3)
        for t, state in enumerate(qpos):
            data.qpos[:] = state
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            for name in ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir"):
                target = getattr(warp_data, name)
                wp.copy(target, wp.array(getattr(data, name)[None].reshape(target.numpy().shape), dtype=target.dtype))
            for context in (colour, ranging):
                mjw.refit_bvh(warp_model, warp_data, context)
                mjw.render(warp_model, warp_data, context)
            mjw.get_rgb(colour, 0, seen)
            rgb[t] = _noisy_colour(seen.numpy()[0], sensing, rng)
            depth[t] = noisy_depth(ranging.depth_data.numpy()[0].reshape(height, width), sensing, rng)
    return ImageStream(np.asarray(time, float), rgb, depth, camera.intrinsics, camera.pose)


def camera_world(world: mujoco.MjSpec, bodies: tuple[str, ...], sensing: SensingCfg) -> mujoco.MjSpec:
    """Return a copy of the world with the camera in it, the pattern on the bodies, and nothing that only moves it.

    States come from the world itself, so what its motion takes is left out, whether the ray tracer's simulator knows it
    or not.
    """
    spec = dress(world, bodies if sensing.object_pattern else ())
    for elements in (spec.keys, spec.sensors, spec.actuators, spec.equalities, spec.tendons):
        for element in list(elements):
            spec.delete(element)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.noslip_iterations = 0
    pose = sensing.pinhole().pose
    quaternion = np.zeros(4)
    # MuJoCo's cameras look along -z and have y up.
    mujoco.mju_mat2Quat(quaternion, (pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])).ravel())
    spec.worldbody.add_camera(name=CAMERA, pos=list(pose[:3, 3]), quat=list(quaternion), fovy=sensing.camera_fovy)
    return spec


def _noisy_colour(colour: np.ndarray, sensing: SensingCfg, rng: np.random.Generator) -> np.ndarray:
    """Return what the sensor reports, uint8, for colours in 0..1, shape (H, W, 3)."""
    if sensing.rgb_blur > 0:
        colour = gaussian_filter(colour, (sensing.rgb_blur, sensing.rgb_blur, 0))
    level = 255 * colour + rng.normal(0, sensing.rgb_std, colour.shape)
    return np.clip(np.round(level), 0, 255).astype(np.uint8)


def noisy_depth(depth: np.ndarray, sensing: SensingCfg, rng: np.random.Generator) -> np.ndarray:
    """Return what the sensor reports for planar depths [m], shape (H, W), 0 where there is nothing.

    The noise grows with the square of the depth, as with all triangulation; near an edge, where one eye sees what the
    other does not, some pixels report nothing; the rest is rounded to the sensor's steps of disparity and of depth.
    """
    noise = rng.normal(0, 1, depth.shape)
    if sensing.depth_correlation > 0:
        noise = gaussian_filter(noise, sensing.depth_correlation)
        noise /= noise.std()
    noisy = depth + noise * sensing.depth_noise * depth**2
    if sensing.disparity_step > 0:
        inverse = np.round(1 / np.maximum(noisy, 1e-3) / sensing.disparity_step) * sensing.disparity_step
        noisy = 1 / np.maximum(inverse, sensing.disparity_step)
    lost = _edges(depth, sensing.depth_jump) & (rng.random(depth.shape) < sensing.depth_dropout)
    return np.where(lost | (depth <= 0), 0.0, np.round(noisy / sensing.depth_step) * sensing.depth_step)


def _edges(depth: np.ndarray, jump: float) -> np.ndarray:
    """Return which pixels have a neighbour whose depth differs by more than `jump` [m], shape (H, W)."""
    result = np.zeros(depth.shape, dtype=bool)
    down = np.abs(np.diff(depth, axis=0)) > jump
    across = np.abs(np.diff(depth, axis=1)) > jump
    result[1:] |= down
    result[:-1] |= down
    result[:, 1:] |= across
    result[:, :-1] |= across
    return result
