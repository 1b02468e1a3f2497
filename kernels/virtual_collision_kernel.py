"""The kernel of the virtual collision penalty: one block of threads for each world, see `virtual_collision`."""

from __future__ import annotations

import warp as wp

from .rollout import UNSTABLE, rotate_by_quaternion

wp.set_module_options({"enable_backward": False})


@wp.struct
class CollisionTables:
    """What does not change from step to step: P pairs, M sets, T targets."""

    pair_set: wp.array[int]  # shape (P,)
    pair_target: wp.array[int]  # shape (P,)
    pair_row: wp.array[int]  # first column in `gap`, shape (P,)
    margin: wp.array[float]  # shape (P,)
    severe: wp.array[float]  # shape (P,)
    gate: wp.array2d[float]  # shape (S, P)
    set_body: wp.array[int]  # shape (M,)
    set_first: wp.array[int]  # first sphere, and the end in the last entry, shape (M + 1,)
    set_centre: wp.array[wp.vec3]  # centre of a sphere about all spheres of the set, body frame, shape (M,)
    set_radius: wp.array[float]  # its radius, shape (M,)
    centre: wp.array[wp.vec3]  # all spheres, body frame, shape (n,)
    radius: wp.array[float]  # shape (n,)
    target_body: wp.array[int]  # shape (T,)
    mesh: wp.array[wp.uint64]  # id, 0 for spheres, shape (T,)
    inside: wp.array[float]  # depth that no point within the mesh exceeds, shape (T,)
    lower: wp.array[wp.vec3]  # bounding box, body frame, shape (T,)
    upper: wp.array[wp.vec3]  # shape (T,)
    target_first: wp.array[int]  # first sphere of the target, shape (T + 1,)
    target_sphere: wp.array[wp.vec4]  # centre and radius, body frame


@wp.func
def rotate_back(q: wp.quat, v: wp.vec3) -> wp.vec3:
    """Rotate a vector by the inverse of a wxyz quaternion."""
    return rotate_by_quaternion(wp.quat(q[0], -q[1], -q[2], -q[3]), v)


@wp.func
def box_distance(x: wp.vec3, lower: wp.vec3, upper: wp.vec3) -> float:
    """Distance of a point to a box, 0 within it."""
    return wp.length(wp.max(wp.max(lower - x, x - upper), wp.vec3()))


@wp.func
def mesh_distance(mesh: wp.uint64, x: wp.vec3, reach: float, far: float) -> float:
    """Signed distance of a point to a mesh; `far` where there is no face within `reach`."""
    distance = far
    query = wp.mesh_query_point_sign_winding_number(mesh, x, reach)
    if query.result:
        distance = query.sign * wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - x)
    return distance


@wp.func
def union_distance(spheres: wp.array[wp.vec4], first: int, end: int, x: wp.vec3, far: float) -> float:
    """Signed distance of a point to a union of spheres where it is below `far`, else `far`."""
    least = far
    for j in range(first, end):
        sphere = spheres[j]
        away = x - wp.vec3(sphere[0], sphere[1], sphere[2])
        square = wp.dot(away, away)
        reach = least + sphere[3]
        if reach > 0.0 and square < reach * reach:
            least = wp.sqrt(square) - sphere[3]
    return least


@wp.kernel
def collision_kernel(
    xpos: wp.array2d[wp.vec3],
    xquat: wp.array2d[wp.quat],
    stage: wp.array[int],
    depth_weight: float,
    band_weight: float,
    severe_penalty: float,
    t: CollisionTables,
    reward: wp.array[float],
    penetration: wp.array[float],
    band: wp.array[float],
    deepest: wp.array[float],
    deepest_pair: wp.array[int],
    severe: wp.array[int],
    finite: wp.array[int],
    gap: wp.array2d[float],
):
    """Write the penalty of a world; one block a world. Arguments as in `VirtualCollision`."""
    world, lane = wp.tid()
    s = stage[world]
    row = wp.clamp(s, 0, t.gate.shape[0] - 1)
    depths = wp.float32(0.0)
    bands = wp.float32(0.0)
    most = wp.float32(0.0)
    most_pair = wp.int32(-1)
    ends = wp.int32(0)
    sane = wp.int32(1)
    for p in range(t.pair_set.shape[0]):
        m = t.pair_set[p]
        k = t.pair_target[p]
        a = t.set_body[m]
        b = t.target_body[k]
        # From the frame of the spheres' body to that of the target's.
        q = xquat[world, a]
        q_target = xquat[world, b]
        origin = rotate_back(q_target, xpos[world, a] - xpos[world, b])
        turn = wp.matrix_from_cols(
            rotate_back(q_target, rotate_by_quaternion(q, wp.vec3(1.0, 0.0, 0.0))),
            rotate_back(q_target, rotate_by_quaternion(q, wp.vec3(0.0, 1.0, 0.0))),
            rotate_back(q_target, rotate_by_quaternion(q, wp.vec3(0.0, 0.0, 1.0))),
        )
        middle = turn @ t.set_centre[m] + origin
        margin = t.margin[p]
        # The second sum catches a pose that is huge or not a number where the first cancels.
        if not (wp.length_sq(middle) + wp.length_sq(xpos[world, a]) < UNSTABLE):
            sane = 0
        elif box_distance(middle, t.lower[k], t.upper[k]) < t.set_radius[m] + margin:
            gate = wp.where(s == row, t.gate[row, p], 0.0)
            for i in range(t.set_first[m] + lane, t.set_first[m + 1], wp.block_dim()):
                x = turn @ t.centre[i] + origin
                r = t.radius[i]
                far = r + margin
                distance = far
                if box_distance(x, t.lower[k], t.upper[k]) < far:
                    if t.mesh[k] != wp.uint64(0):
                        # A query finds nothing beyond its reach: it must reach the surface from anywhere within.
                        distance = mesh_distance(t.mesh[k], x, wp.max(far, t.inside[k]), far)
                    else:
                        distance = union_distance(t.target_sphere, t.target_first[k], t.target_first[k + 1], x, far)
                if distance < far:
                    g = distance - r
                    depth = wp.max(-g, 0.0)
                    depths += depth
                    if depth > most:
                        most = depth
                        most_pair = p
                    if depth > t.severe[p]:
                        ends = 1
                    if margin > 0.0:
                        nearness = wp.min((margin - g) / margin, 1.0)
                        bands += gate * nearness * nearness
                    if gap.shape[0] > 0:
                        gap[world, t.pair_row[p] + i - t.set_first[m]] = g
    if sane == 0:
        depths = 0.0
        bands = 0.0
        most = 0.0
        most_pair = -1
        ends = 0
    all_depths = wp.tile_sum(wp.tile(depths))[0]
    all_bands = wp.tile_sum(wp.tile(bands))[0]
    all_most = wp.tile_max(wp.tile(most))[0]
    all_ends = wp.tile_max(wp.tile(ends))[0]
    # The first pair of those as deep as the deepest; a lane that has none does not take part.
    first_pair = wp.tile_min(wp.tile(wp.where(most_pair >= 0 and most == all_most, most_pair, t.pair_set.shape[0])))[0]
    if lane == 0:
        penetration[world] = all_depths
        band[world] = all_bands
        deepest[world] = all_most
        deepest_pair[world] = wp.where(first_pair < t.pair_set.shape[0], first_pair, -1)
        severe[world] = all_ends
        finite[world] = sane
        reward[world] = -(depth_weight * all_depths + band_weight * all_bands + severe_penalty * wp.float32(all_ends))
