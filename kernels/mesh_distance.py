"""Nearest face of a closed triangle mesh, and on which side of the surface a point lies."""

from __future__ import annotations

import warp as wp


@wp.kernel
def nearest_face(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    reach: float,
    face: wp.array(dtype=wp.int32),
    side: wp.array(dtype=wp.float32),
):
    """Write the nearest face of each point and the sign of its distance: -1 inside, 1 outside, by winding number.

    Args:
        mesh: id of a `warp.Mesh` built with ``support_winding_number=True``.
        points: points [m], shape (n,).
        reach: largest distance searched [m]; a point without a face in reach gets face -1.
        face: index of the nearest face, shape (n,), written.
        side: sign of the distance, shape (n,), written.
    """
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], reach)
    face[i] = -1
    if query.result:
        face[i] = query.face
        side[i] = query.sign
