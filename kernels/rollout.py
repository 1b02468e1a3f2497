"""What happens around the steps of a batched simulation, on the device: commands in, records and contacts out.

A clock of two counters keeps the host out of the loop. `command_kernel` reads ``clock[0]`` and leaves the step in
``clock[1]`` for the kernels after it; `record_kernel` reads ``clock[1]`` and leaves the next step in ``clock[0]``. So
no kernel reads a counter that another of its threads writes.

Quaternions are wxyz, stored in `wp.quat` as four plain numbers, as in MuJoCo-Warp.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

UNSTABLE = wp.constant(1.0e10)
"""Magnitude of a position, velocity or acceleration above which C MuJoCo, too, calls a simulation unstable."""

PEAK_CONTACTS = 0
PEAK_PAIRS = 1
PEAK_CONSTRAINTS = 2
PEAK_LOGGED = 3
PEAKS = 4
"""Entries of `peak`: contacts and candidate pairs of all worlds, constraint rows of one world, rows in the log."""


@wp.kernel
def command_kernel(
    steps: int,
    commands: wp.array3d[float],
    clock: wp.array[int],
    ctrl: wp.array2d[float],
):
    """Hold the commands of this step; dim (N, max(nu, 1)).

    Args:
        steps: K.
        commands: Shape (n, K, nu); world i follows row i % n.
        clock: Shape (2,).
        ctrl: Shape (N, nu), written.
    """
    world, i = wp.tid()
    step = clock[0]
    if world == 0 and i == 0:
        clock[1] = step
    if i < ctrl.shape[1] and steps > 0:
        ctrl[world, i] = commands[world % commands.shape[0], wp.min(step, steps - 1), i]


@wp.func
def record_unstable_step(value: float, world: int, step: int, unstable_step: wp.array[int]):
    """Note the step if the value is huge or not a number."""
    if not (wp.abs(value) < UNSTABLE):
        wp.atomic_min(unstable_step, world, step)


@wp.kernel
def record_kernel(
    row_of: wp.array[int],
    bodies: wp.array[int],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    qacc: wp.array2d[float],
    sensordata: wp.array2d[float],
    xpos: wp.array2d[wp.vec3],
    xquat: wp.array2d[wp.quat],
    contacts: wp.array[int],
    pairs: wp.array[int],
    constraints: wp.array[int],
    clock: wp.array[int],
    peak: wp.array[int],
    unstable_step: wp.array[int],
    out_qpos: wp.array3d[float],
    out_qvel: wp.array3d[float],
    out_sensordata: wp.array3d[float],
    out_position: wp.array3d[wp.vec3],
    out_quaternion: wp.array3d[wp.quat],
):
    """Record a step, if it is one to record, and watch over buffers and stability.

    Dim (N, max(nq, nv, nsensordata, B, 1)).

    Args:
        row_of: Row to record each step in or -1, shape (K + 1,).
        bodies: Ids of the bodies to record, shape (B,).
        qpos: Shape (N, nq).
        qvel: Shape (N, nv).
        qacc: Shape (N, nv).
        sensordata: Shape (N, nsensordata).
        xpos: Body origins [m], shape (N, nbody).
        xquat: Body orientations, shape (N, nbody).
        contacts: Contacts found in all worlds, shape (1,).
        pairs: Candidate pairs found in all worlds, shape (1,).
        constraints: Constraint rows of each world, shape (N,).
        clock: Shape (2,).
        peak: Largest demands so far, shape (PEAKS,).
        unstable_step: First step that is not sane in each world, shape (N,).
        out_qpos: Shape (N, R, nq), written; likewise all that follow.
        out_qvel: Shape (N, R, nv).
        out_sensordata: Shape (N, R, nsensordata).
        out_position: Shape (N, R, B).
        out_quaternion: Shape (N, R, B).
    """
    world, i = wp.tid()
    step = clock[1]
    if i == 0:
        wp.atomic_max(peak, PEAK_CONSTRAINTS, constraints[world])
        if world == 0:
            clock[0] = step + 1
            wp.atomic_max(peak, PEAK_CONTACTS, contacts[0])
            wp.atomic_max(peak, PEAK_PAIRS, pairs[0])

    if i < qpos.shape[1]:
        record_unstable_step(qpos[world, i], world, step, unstable_step)
    if i < qvel.shape[1]:
        record_unstable_step(qvel[world, i], world, step, unstable_step)
        record_unstable_step(qacc[world, i], world, step, unstable_step)

    row = row_of[step]
    if row < 0:
        return
    if i < qpos.shape[1]:
        out_qpos[world, row, i] = qpos[world, i]
    if i < qvel.shape[1]:
        out_qvel[world, row, i] = qvel[world, i]
    if i < sensordata.shape[1]:
        out_sensordata[world, row, i] = sensordata[world, i]
    if i < bodies.shape[0]:
        out_position[world, row, i] = xpos[world, bodies[i]]
        out_quaternion[world, row, i] = xquat[world, bodies[i]]


@wp.kernel
def touch_kernel(
    contacts: wp.array[int],
    world_of: wp.array[int],
    geom: wp.array[wp.vec2i],
    address: wp.array2d[int],
    body_of: wp.array[int],
    touched: wp.array3d[wp.uint8],
):
    """Mark which geom is in contact with which body; dim the contact capacity.

    Args:
        contacts: Contacts found in all worlds, shape (1,).
        world_of: World of each contact, shape (capacity,).
        geom: Its two geoms, shape (capacity,).
        address: Its constraint rows, -1 where it is not active, shape (capacity, rows).
        body_of: Body of each geom, shape (ngeom,).
        touched: Shape (N, ngeom, nbody), set to 1.
    """
    i = wp.tid()
    if i >= contacts[0]:
        return
    if address[i, 0] < 0:
        return
    pair = geom[i]
    world = world_of[i]
    touched[world, pair[0], body_of[pair[1]]] = wp.uint8(1)
    touched[world, pair[1], body_of[pair[0]]] = wp.uint8(1)


@wp.kernel
def log_kernel(
    contacts: wp.array[int],
    world_of: wp.array[int],
    geom: wp.array[wp.vec2i],
    address: wp.array2d[int],
    distance: wp.array[float],
    position: wp.array[wp.vec3],
    frame: wp.array[wp.mat33],
    force: wp.array[wp.spatial_vector],
    clock: wp.array[int],
    peak: wp.array[int],
    key: wp.array2d[int],
    value: wp.array2d[float],
):
    """Append the active contacts to the log; dim the contact capacity.

    Rows beyond the end of the log are counted but not written.

    Args:
        contacts: Contacts found in all worlds, shape (1,).
        world_of: World of each contact, shape (capacity,).
        geom: Its two geoms, shape (capacity,).
        address: Its constraint rows, -1 where it is not active, shape (capacity, rows).
        distance: Its signed gap [m], shape (capacity,).
        position: Its point [m], shape (capacity,).
        frame: Its frame, normal first, shape (capacity,).
        force: Its force [N] and torque [N m] on the second geom, world frame, shape (capacity,).
        clock: Shape (2,).
        peak: Shape (PEAKS,).
        key: World, step and geoms, the smaller id first, shape (rows, 4), written.
        value: Position, normal, distance and force on the second geom of the key, shape (rows, 10), written.
    """
    i = wp.tid()
    if i >= contacts[0]:
        return
    if address[i, 0] < 0:
        return
    row = wp.atomic_add(peak, PEAK_LOGGED, 1)
    if row >= key.shape[0]:
        return
    pair = geom[i]
    sign = wp.where(pair[0] > pair[1], -1.0, 1.0)
    key[row, 0] = world_of[i]
    key[row, 1] = clock[1]
    key[row, 2] = wp.min(pair[0], pair[1])
    key[row, 3] = wp.max(pair[0], pair[1])
    value[row, 6] = distance[i]
    for k in range(3):
        value[row, k] = position[i][k]
        value[row, 3 + k] = sign * frame[i][0, k]
        value[row, 7 + k] = sign * force[i][k]


@wp.func
def rotate_by_quaternion(q: wp.quat, v: wp.vec3) -> wp.vec3:
    """Rotate a vector by a wxyz quaternion."""
    u = wp.vec3(q[1], q[2], q[3])
    t = 2.0 * wp.cross(u, v)
    return v + q[0] * t + wp.cross(u, t)


@wp.kernel
def place_geoms_kernel(
    geoms: wp.array[int],
    body_of: wp.array[int],
    geom_pos: wp.array2d[wp.vec3],
    geom_quat: wp.array2d[wp.quat],
    xpos: wp.array2d[wp.vec3],
    xquat: wp.array2d[wp.quat],
    geom_xpos: wp.array2d[wp.vec3],
    geom_xmat: wp.array2d[wp.mat33],
):
    """Place geoms in the world from the poses of their bodies; dim (N, G).

    MuJoCo-Warp places the geoms of static bodies once, when its data are made, and with one geometry for all worlds.

    Args:
        geoms: Ids of the geoms to place, shape (G,).
        body_of: Body of each geom, shape (ngeom,).
        geom_pos: Positions in the body frame [m], shape (1 or N, ngeom).
        geom_quat: Orientations in the body frame, shape (1 or N, ngeom).
        xpos: Body origins [m], shape (N, nbody).
        xquat: Body orientations, shape (N, nbody).
        geom_xpos: Positions in the world [m], shape (N, ngeom), written.
        geom_xmat: Orientations in the world, shape (N, ngeom), written.
    """
    world, i = wp.tid()
    geom = geoms[i]
    body = body_of[geom]
    q = xquat[world, body]
    local = geom_quat[world % geom_quat.shape[0], geom]
    geom_xpos[world, geom] = xpos[world, body] + rotate_by_quaternion(q, geom_pos[world % geom_pos.shape[0], geom])
    x = rotate_by_quaternion(q, rotate_by_quaternion(local, wp.vec3(1.0, 0.0, 0.0)))
    y = rotate_by_quaternion(q, rotate_by_quaternion(local, wp.vec3(0.0, 1.0, 0.0)))
    z = rotate_by_quaternion(q, rotate_by_quaternion(local, wp.vec3(0.0, 0.0, 1.0)))
    geom_xmat[world, geom] = wp.matrix_from_cols(x, y, z)
