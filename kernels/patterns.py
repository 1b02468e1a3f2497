"""Patterns on the surfaces of a ray-traced image, and what is behind them; colours as bytes, channels first."""

from __future__ import annotations

from typing import Any

import warp as wp

WAVES = 4
"""Sine waves of a pattern."""

wp.set_module_options({"enable_backward": False})


@wp.func
def _cell(place: wp.vec3, seed: int) -> float:
    """Return the random number in -1..1 of the unit cube that a place is in."""
    x, y, z = int(wp.floor(place[0])), int(wp.floor(place[1])), int(wp.floor(place[2]))
    # Large primes spread neighbouring cubes (Teschner et al., "Optimized spatial hashing", VMV 2003).
    state = wp.rand_init(seed, (x * 73856093) ^ (y * 19349663) ^ (z * 83492791))
    return wp.randf(state, -1.0, 1.0)


@wp.kernel
def paint_patterns_kernel(
    colour: wp.array4d(dtype=wp.vec3),
    depth: wp.array4d(dtype=float),
    segmentation: wp.array4d(dtype=int),
    camera: wp.array(dtype=int),
    focal: wp.array(dtype=float),
    camera_position: wp.array2d(dtype=wp.vec3),
    camera_matrix: wp.array2d(dtype=wp.mat33),
    body_of: wp.array(dtype=int),
    whole: wp.array(dtype=int),
    body_position: wp.array2d(dtype=wp.vec3),
    body_quaternion: wp.array2d(dtype=wp.quat),
    waves: wp.array3d(dtype=wp.vec4),
    contrast: wp.array2d(dtype=float),
    grain: wp.array2d(dtype=wp.vec3),
    background: wp.array3d(dtype=wp.vec3),
    image: wp.array4d(dtype=wp.uint8),
) -> None:
    """Write the image of a pixel.

    Launched over worlds, cameras, rows and columns.

    Args:
        colour: Colours 0..1, shape (W, C, H, W').
        depth: Distances along the cameras' axes [m], shape (W, C, H, W').
        segmentation: Geom of each pixel, -1 where nothing is, shape (W, C, H, W').
        camera: Ids of the cameras, shape (C,).
        focal: Their focal lengths [px], shape (C,).
        camera_position: Positions of all cameras [m], shape (W, ncam).
        camera_matrix: Their orientations, shape (W, ncam).
        body_of: Body of each geom, shape (ngeom,).
        whole: The geom whose pattern each one has, shape (ngeom,).
        body_position: Origins of bodies [m], shape (W, nbody).
        body_quaternion: Their orientations, wxyz, shape (W, nbody).
        waves: Wave vectors [rad/m] and phases of the patterns, shape (W, P, WAVES); geom g has pattern g % P.
        contrast: Contrast of the patterns [-], shape (W, P).
        grain: Cells per length [1/m], contrast of the cells [-] and a seed, shape (W, P): surfaces are divided into
            cubes of the body's frame, each of a brightness of its own.
        background: Colours at the upper and the lower edge where nothing is, shape (W, C, 2).
        image: Colours 0..255, shape (W * C, 3, H, W').
    """
    world, c, v, u = wp.tid()
    height, width = colour.shape[2], colour.shape[3]
    geom = segmentation[world, c, v, u]
    light = colour[world, c, v, u]
    if geom < 0:
        share = float(v) / float(height)
        light = background[world, c, 0] * (1.0 - share) + background[world, c, 1] * share
    else:
        which = camera[c]
        far = depth[world, c, v, u]
        ray = wp.vec3(
            (float(u) + 0.5 - 0.5 * float(width)) / focal[c], (0.5 * float(height) - float(v) - 0.5) / focal[c], -1.0
        )
        point = camera_position[world, which] + camera_matrix[world, which] * (ray * far)
        body = body_of[geom]
        q = body_quaternion[world, body]
        # Stored as wxyz, while Warp's quaternions are xyzw.
        turn = wp.quat(q[1], q[2], q[3], q[0])
        local = wp.quat_rotate_inv(turn, point - body_position[world, body])
        pattern = whole[geom] % contrast.shape[1]
        level = float(0.0)  # noqa: UP018  (a constant cannot change in a loop)
        for k in range(wp.static(WAVES)):
            wave = waves[world, pattern, k]
            level += wp.sin(wave[0] * local[0] + wave[1] * local[1] + wave[2] * local[2] + wave[3])
        light = light * (1.0 + contrast[world, pattern] * level / float(wp.static(WAVES)))
        grains = grain[world, pattern]
        light = light * (1.0 + grains[1] * _cell(local * grains[0], int(grains[2])))
    for k in range(3):
        image[world * colour.shape[1] + c, k, v, u] = wp.uint8(wp.clamp(255.0 * light[k] + 0.5, 0.0, 255.0))


def paint_patterns(inputs: list[Any], image: wp.array, device: Any) -> None:
    """Launch `paint_patterns_kernel` for all pixels; `inputs` in its order, the last argument is `image`."""
    wp.launch(paint_patterns_kernel, dim=inputs[0].shape, inputs=inputs, outputs=[image], device=device)
