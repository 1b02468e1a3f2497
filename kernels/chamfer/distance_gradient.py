"""From the indices of nearest points: their mean distance, on either device, and its gradient, on a CPU.

With n_a and n_b points present, d_i = a_i - b_near(i) and e_j = b_j - a_near(j),

    a_to_b = 1/n_a sum_i |d_i|,    d a_to_b / d a_i = d_i / (n_a |d_i|),    d a_to_b / d b_near(i) = -d_i / (n_a |d_i|)

and likewise for b_to_a with e_j; squared, |d|^2 stands for |d| and 2 d for d / |d|. The gradient of a distance of zero
is taken as zero (a subgradient). An index of -1 marks a missing point, -2 one that has no partner.
"""

from __future__ import annotations

import warp as wp


@wp.func
def batch_index(problem: int, batch: wp.vec2i) -> int:
    """Return the set that a problem uses: its index divided by batch[0], modulo batch[1]."""
    return (problem / batch[0]) % batch[1]


@wp.func
def slope(difference: wp.vec3, squared: bool) -> wp.vec3:
    """Return the derivative of |d| (or |d|^2) with respect to d [-, or m]."""
    if squared:
        return 2.0 * difference
    return wp.normalize(difference)  # zero for zero


@wp.kernel(module="unique", enable_backward=False)
def mean_distance(
    query: wp.array2d[wp.vec3],
    reference: wp.array2d[wp.vec3],
    query_batch: wp.vec2i,
    reference_batch: wp.vec2i,
    nearest: wp.array2d[int],
    squared: bool,
    threads: int,
    mean: wp.array[float],
    count: wp.array[int],
):
    """Mean distance from each query point to its nearest; a block of `threads` threads takes one problem."""
    problem, thread = wp.tid()
    q = batch_index(problem, query_batch)
    r = batch_index(problem, reference_batch)
    total = wp.float32(0.0)
    present = wp.int32(0)
    for i in range(thread, nearest.shape[1], threads):
        j = nearest[problem, i]
        if j != -1:
            present += 1
        if j >= 0:
            d = query[q, i] - reference[r, j]
            if squared:
                total += wp.length_sq(d)
            else:
                total += wp.length(d)
    all_present = wp.tile_sum(wp.tile(present))[0]
    whole = wp.tile_sum(wp.tile(total))[0]
    if thread == 0:
        count[problem] = all_present
        mean[problem] = whole / float(wp.max(all_present, 1))


@wp.kernel(module="unique", enable_backward=False)
def gradient_by_scattering(
    own: wp.array2d[wp.vec3],
    other: wp.array2d[wp.vec3],
    own_batch: wp.vec2i,
    other_batch: wp.vec2i,
    own_nearest: wp.array2d[int],
    other_nearest: wp.array2d[int],
    own_count: wp.array[int],
    other_count: wp.array[int],
    own_upstream: wp.array[float],
    other_upstream: wp.array[float],
    squared: bool,
    gradient: wp.array2d[wp.vec3],
):
    """Gradient with respect to the own points of each problem; one thread takes a problem, so a CPU kernel."""
    problem = wp.tid()
    s = batch_index(problem, own_batch)
    o = batch_index(problem, other_batch)
    for i in range(own_nearest.shape[1]):
        near = own_nearest[problem, i]
        if near >= 0:
            weight = own_upstream[problem] / float(own_count[problem])
            gradient[problem, i] = slope(own[s, i] - other[o, near], squared) * weight
        else:
            gradient[problem, i] = wp.vec3()
    for j in range(other_nearest.shape[1]):
        i = other_nearest[problem, j]
        if i >= 0:
            weight = other_upstream[problem] / float(other_count[problem])
            gradient[problem, i] = gradient[problem, i] + slope(own[s, i] - other[o, j], squared) * weight
