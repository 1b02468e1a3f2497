"""Blending of sorted Gaussians into pixels, front to back, and its gradient.

With opacities a_i = o_i exp(-d^T Q d / 2), d from the pixel to the mean and Q the inverse covariance, front to back,

    T_i = prod_{j<i} (1 - a_j)
    rgb = sum_i T_i a_i c_i,    alpha = 1 - T_end,    depth = sum_i T_i a_i z_i / alpha

("3D Gaussian Splatting", 2023, equation 3). Opacities below 1/255 do not count, none is above 0.999, and a pixel is
done when T is below 1e-4. Gaussians that lie behind the surface that a simulation sees at a pixel are not blended. The
gradient goes back to front, T divided by what it was multiplied with.
"""

from __future__ import annotations

import warp as wp

from .projection import Frame

wp.set_module_options({"enable_backward": False})

MAX_OPACITY = wp.constant(0.999)
"""Largest opacity at a pixel."""
MIN_TRANSMITTANCE = wp.constant(1.0e-4)
"""Transmittance below which nothing more is blended."""


@wp.struct
class TileLists:
    """Gaussians of each tile, and their projections."""

    first: wp.array[int]  # where a tile's list begins, and the end of the last, shape (images * tiles + 1,)
    order: wp.array[int]  # indices into the projections
    place: wp.array[wp.vec4]
    shape: wp.array[wp.vec4]
    colour: wp.array[wp.vec3]


@wp.func
def exponent(place: wp.vec4, shape: wp.vec4, x: float, y: float) -> float:
    """Return d^T Q d / 2 at a pixel."""
    dx = place[0] - x
    dy = place[1] - y
    return 0.5 * (shape[0] * dx * dx + shape[2] * dy * dy) + shape[1] * dx * dy


@wp.kernel
def blend(
    frame: Frame,
    lists: TileLists,
    hidden: wp.array3d[float],
    margin: float,
    rgb: wp.array3d[wp.vec3],
    alpha: wp.array3d[float],
    depth: wp.array3d[float],
    left: wp.array3d[float],
    last: wp.array3d[int],
):
    """Blend one pixel; a block of threads takes a tile.

    `hidden`, shape (images, H, W), is the depth [m] beyond which a pixel shows nothing, 0 for none, or has size 0.
    `left` becomes the transmittance, of which `alpha` keeps fewer digits, and `last` the end of the part of the list
    that was blended.
    """
    tile, pixel = wp.tid()
    in_row = pixel / frame.tile
    image = tile / (frame.rows * frame.columns)
    in_image = tile - image * frame.rows * frame.columns
    row = (in_image / frame.columns) * frame.tile + in_row
    column = (in_image % frame.columns) * frame.tile + pixel - in_row * frame.tile
    if row >= frame.height or column >= frame.width:
        return
    deepest = wp.float32(1.0e30)
    if hidden.shape[0] > 0 and hidden[image, row, column] > 0.0:
        deepest = hidden[image, row, column] + margin
    x = float(column)
    y = float(row)
    through = wp.float32(1.0)
    light = wp.vec3()
    distance = wp.float32(0.0)
    end = lists.first[tile]
    for j in range(lists.first[tile], lists.first[tile + 1]):
        k = lists.order[j]
        place = lists.place[k]
        if place[2] > deepest:
            break
        shape = lists.shape[k]
        power = exponent(place, shape, x, y)
        if power < shape[3]:
            a = wp.min(place[3] * wp.exp(-power), MAX_OPACITY)
            weight = through * a
            light += weight * lists.colour[k]
            distance += weight * place[2]
            through *= 1.0 - a
            end = j + 1
            if through < MIN_TRANSMITTANCE:
                break
    covered = 1.0 - through
    rgb[image, row, column] = light
    alpha[image, row, column] = covered
    if covered > 0.0:
        distance /= covered
    depth[image, row, column] = distance
    left[image, row, column] = through
    last[image, row, column] = end


@wp.kernel
def blend_gradient(
    frame: Frame,
    lists: TileLists,
    alpha: wp.array3d[float],
    depth: wp.array3d[float],
    left: wp.array3d[float],
    last: wp.array3d[int],
    rgb_upstream: wp.array3d[wp.vec3],
    alpha_upstream: wp.array3d[float],
    depth_upstream: wp.array3d[float],
    place_gradient: wp.array[wp.vec4],
    shape_gradient: wp.array[wp.vec4],
    colour_gradient: wp.array[wp.vec3],
):
    """Add a pixel's part to the gradients with respect to the projections."""
    tile, pixel = wp.tid()
    in_row = pixel / frame.tile
    image = tile / (frame.rows * frame.columns)
    in_image = tile - image * frame.rows * frame.columns
    row = (in_image / frame.columns) * frame.tile + in_row
    column = (in_image % frame.columns) * frame.tile + pixel - in_row * frame.tile
    if row >= frame.height or column >= frame.width:
        return
    covered = alpha[image, row, column]
    if covered <= 0.0:
        return
    to_rgb = rgb_upstream[image, row, column]
    to_distance = depth_upstream[image, row, column] / covered
    to_alpha = alpha_upstream[image, row, column] - to_distance * depth[image, row, column]
    x = float(column)
    y = float(row)
    end_through = left[image, row, column]
    through = end_through
    behind = wp.float32(0.0)
    first = lists.first[tile]
    length = last[image, row, column] - first
    for n in range(length):
        k = lists.order[first + length - 1 - n]
        place = lists.place[k]
        shape = lists.shape[k]
        power = exponent(place, shape, x, y)
        if power < shape[3]:
            falloff = wp.exp(-power)
            plain = place[3] * falloff
            a = wp.min(plain, MAX_OPACITY)
            through /= 1.0 - a
            weight = through * a
            worth = wp.dot(lists.colour[k], to_rgb) + place[2] * to_distance
            to_a = through * worth + (end_through * to_alpha - behind) / (1.0 - a)
            behind += weight * worth
            to_place = wp.vec4(0.0, 0.0, weight * to_distance, 0.0)
            if plain < MAX_OPACITY:
                to_power = -a * to_a
                dx = place[0] - x
                dy = place[1] - y
                to_place[0] = to_power * (shape[0] * dx + shape[1] * dy)
                to_place[1] = to_power * (shape[1] * dx + shape[2] * dy)
                to_place[3] = falloff * to_a
                to_shape = wp.vec4(0.5 * dx * dx, dx * dy, 0.5 * dy * dy, 0.0)
                wp.atomic_add(shape_gradient, k, to_power * to_shape)
            wp.atomic_add(place_gradient, k, to_place)
            wp.atomic_add(colour_gradient, k, weight * to_rgb)
