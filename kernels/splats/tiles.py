"""From projected Gaussians to a list for each tile of each image, nearest first: counts, prefix sum, keys, radix sort.

A key is the number of the tile, image by image, and below it the depth. Depths are ordered by the bits of the number,
which for positive floats grow with it; a few of the lowest are left out, so that the sort has fewer bits to go through:
what is nearer to each other than a millionth of the depth stays in the order of the Gaussians.
"""

from __future__ import annotations

import struct

import warp as wp

from .projection import MIN_DEPTH, Frame

wp.set_module_options({"enable_backward": False})

DEPTH_BITS = 24
"""Bits of a depth in a key: enough from 0.01 m to 600 m with all but the three lowest bits."""
TILE_SHIFT = wp.constant(wp.int64(DEPTH_BITS))
MAX_DEPTH_KEY = wp.constant(2**DEPTH_BITS - 1)
MIN_DEPTH_BITS = wp.constant(struct.unpack("<i", struct.pack("<f", MIN_DEPTH))[0])
"""The bits of the least depth."""


@wp.func
def depth_key(depth: float) -> int:
    """Return the depth as an integer that grows with it."""
    return wp.min((wp.cast(depth, int) - MIN_DEPTH_BITS) >> 3, MAX_DEPTH_KEY)


@wp.kernel
def count_pairs(end: wp.array[int], splats: int, capacity: int, pairs: wp.array[int], overflow: wp.array[int]):
    """Count the pairs of Gaussian and tile of an image, and those of them beyond the capacity."""
    image = wp.tid()
    last = end[(image + 1) * splats - 1]
    first = wp.int32(0)
    if image > 0:
        first = end[image * splats - 1]
    pairs[image] = last - first
    overflow[image] = wp.clamp(last - capacity, 0, last - first)


@wp.kernel
def write_keys(
    frame: Frame,
    splats: int,
    capacity: int,
    place: wp.array[wp.vec4],
    bounds: wp.array[wp.vec4i],
    count: wp.array[int],
    end: wp.array[int],
    key: wp.array[wp.int64],
    value: wp.array[int],
):
    """Write a key for each tile that a Gaussian reaches."""
    image, i = wp.tid()
    k = image * splats + i
    if count[k] > 0:
        at = end[k] - count[k]
        reach = bounds[k]
        depth = wp.int64(depth_key(place[k][2]))
        first = image * frame.rows * frame.columns
        for row in range(reach[2], reach[3]):
            for column in range(reach[0], reach[1]):
                if at < capacity:
                    key[at] = (wp.int64(first + row * frame.columns + column) << TILE_SHIFT) | depth
                    value[at] = k
                at += 1


@wp.kernel
def fill_unused_keys(end: wp.array[int], beyond: wp.int64, key: wp.array[wp.int64]):
    """Give what is not used the number of a tile after the last."""
    i = wp.tid()
    if i >= end[end.shape[0] - 1]:
        key[i] = beyond << TILE_SHIFT


@wp.kernel
def find_tiles(key: wp.array[wp.int64], capacity: int, first: wp.array[int]):
    """Find where a tile's keys begin in the sorted list, by bisection; those of the next begin where they end."""
    tile = wp.tid()
    sought = wp.int64(tile) << TILE_SHIFT
    low = wp.int32(0)
    high = wp.int32(capacity)
    while low < high:
        middle = (low + high) / 2
        if key[middle] < sought:
            low = middle + 1
        else:
            high = middle
    first[tile] = low
