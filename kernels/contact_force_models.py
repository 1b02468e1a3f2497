"""Forces of contacts that MuJoCo has no field for, in all worlds of MuJoCo-Warp; see `force_models`."""

from __future__ import annotations

from typing import Any

import mujoco
import mujoco_warp as mjw
import warp as wp

wp.set_module_options({"enable_backward": False})

PLANE = wp.constant(int(mujoco.mjtGeom.mjGEOM_PLANE))
PYRAMIDAL = wp.constant(int(mujoco.mjtCone.mjCONE_PYRAMIDAL))


def add_anisotropic_friction(
    m: mjw.Model, d: mjw.Data, moving: wp.array[Any], still: wp.array[Any], values: wp.array[Any], smooth: float
) -> None:
    """Add -(ratio - 1) mu N v_y / sqrt(|v|^2 + v0^2) along y where a body slides on what stands still.

    Args:
        m: Model.
        d: Data; `xfrc_applied` is added to.
        moving: Which geoms are the body's, shape (ngeom,) bool.
        still: Which geoms stand still, shape (ngeom,) bool.
        values: The ratio, shape (N, 1).
        smooth: v0 [m/s].
    """
    contact = d.contact
    wp.launch(
        anisotropic_kernel,
        dim=d.naconmax,
        inputs=[
            int(m.opt.cone),
            moving,
            still,
            values,
            smooth,
            m.geom_bodyid,
            m.body_rootid,
            d.nacon,
            contact.worldid,
            contact.geom,
            contact.dim,
            contact.efc_address,
            contact.pos,
            contact.frame,
            contact.friction,
            d.efc.force,
            d.xipos,
            d.subtree_com,
            d.cvel,
        ],
        outputs=[d.xfrc_applied],
    )


def add_turning_friction(
    m: mjw.Model,
    d: mjw.Data,
    moving: wp.array[Any],
    still: wp.array[Any],
    values: wp.array[Any],
    contacts: float,
    *,
    rolling: bool,
) -> None:
    """Add a torque of at most c N against rotation where a body touches what stands still.

    Args:
        m: Model.
        d: Data; `xfrc_applied` is added to.
        moving: Which geoms are the body's, shape (ngeom,) bool.
        still: Which geoms stand still, shape (ngeom,) bool.
        values: The coefficient c [m], shape (N, 1).
        contacts: Contacts that together stop the body in one step at most [-].
        rolling: Whether it acts against rolling, else against turning in place.
    """
    contact = d.contact
    wp.launch(
        turning_kernel,
        dim=d.naconmax,
        inputs=[
            int(m.opt.cone),
            moving,
            still,
            values,
            contacts,
            wp.bool(rolling),
            m.opt.timestep,
            m.geom_bodyid,
            m.body_inertia,
            d.nacon,
            contact.worldid,
            contact.geom,
            contact.dim,
            contact.efc_address,
            contact.frame,
            d.efc.force,
            d.ximat,
            d.cvel,
        ],
        outputs=[d.xfrc_applied],
    )


def add_adhesion(
    m: mjw.Model,
    d: mjw.Data,
    geom: wp.array[Any],
    point: wp.array[Any],
    rounded: wp.array[Any],
    still: wp.array[Any],
    values: wp.array[Any],
    gap: float,
) -> None:
    """Pull points of a body that lie within a gap of a plane or box that stands still towards it.

    Args:
        m: Model.
        d: Data; `xfrc_applied` is added to.
        geom: Geom of each point, shape (P,) int.
        point: Points in the frames of their geoms [m], shape (P,) of vectors.
        rounded: Whether the geom's first size is a radius about the point, shape (P,) bool.
        still: Planes and boxes, shape (n,) int.
        values: Force at each point [N], shape (N, 1).
        gap: [m].
    """
    wp.launch(
        adhesion_kernel,
        dim=(d.nworld, geom.size, still.size),
        inputs=[
            geom,
            point,
            rounded,
            still,
            values,
            gap,
            m.geom_type,
            m.geom_size,
            m.geom_bodyid,
            d.time,
            d.geom_xpos,
            d.geom_xmat,
            d.xipos,
        ],
        outputs=[d.xfrc_applied],
    )


@wp.func
def own_geom(pair: wp.vec2i, moving: wp.array[bool], still: wp.array[bool]) -> int:
    """Return which of two geoms is the body's where the other one stands still, else -1."""
    if pair[0] < 0 or pair[1] < 0:
        return -1
    if moving[pair[1]] and still[pair[0]]:
        return pair[1]
    if moving[pair[0]] and still[pair[1]]:
        return pair[0]
    return -1


@wp.func
def normal_force(cone: int, condim: int, first: int, efc_force: wp.array[float]) -> float:
    """Return the normal force of a contact [N]: a pyramid's edges each carry a share of it."""
    pressed = efc_force[first]
    rows = wp.where(cone == PYRAMIDAL and condim > 1, 2 * (condim - 1), 1)
    for k in range(1, rows):
        if first + k < efc_force.shape[0]:
            pressed += efc_force[first + k]
    return pressed


@wp.kernel
def anisotropic_kernel(
    cone: int,
    moving: wp.array[bool],
    still: wp.array[bool],
    values: wp.array2d[float],
    smooth: float,
    body_of: wp.array[int],
    root_of: wp.array[int],
    contacts: wp.array[int],
    world_of: wp.array[int],
    geom: wp.array[wp.vec2i],
    condim: wp.array[int],
    address: wp.array2d[int],
    position: wp.array[wp.vec3],
    frame: wp.array[wp.mat33],
    friction: wp.array[Any],
    efc_force: wp.array2d[float],
    xipos: wp.array2d[wp.vec3],
    subtree_com: wp.array2d[wp.vec3],
    cvel: wp.array2d[wp.spatial_vector],
    applied: wp.array2d[wp.spatial_vector],
):
    """See `add_anisotropic_friction`; dim the contact capacity.

    Args:
        cone: Kind of friction cone.
        moving: Shape (ngeom,).
        still: Shape (ngeom,).
        values: Shape (N, 1).
        smooth: [m/s].
        body_of: Body of each geom, shape (ngeom,).
        root_of: Root of each body's tree, shape (nbody,).
        contacts: Contacts found in all worlds, shape (1,).
        world_of: World of each contact, shape (capacity,).
        geom: Its two geoms, shape (capacity,).
        condim: Its dimensions, shape (capacity,).
        address: Its constraint rows, -1 where it is not active, shape (capacity, rows).
        position: Its point [m], shape (capacity,).
        frame: Its frame, normal first, shape (capacity,).
        friction: Its coefficients, sliding first, shape (capacity,).
        efc_force: Forces of the constraint rows, shape (N, rows).
        xipos: Centres of mass [m], shape (N, nbody).
        subtree_com: Centres of mass of trees [m], shape (N, nbody).
        cvel: Angular and linear velocities of bodies about those of their trees, shape (N, nbody).
        applied: Forces and torques on bodies, shape (N, nbody), added to.
    """
    i = wp.tid()
    if i >= contacts[0]:
        return
    mine = own_geom(geom[i], moving, still)
    if address[i, 0] < 0 or condim[i] < 3 or mine < 0:
        return
    world = world_of[i]
    pressed = normal_force(cone, condim[i], address[i, 0], efc_force[world])
    body = body_of[mine]
    moved = cvel[world, body]
    velocity = wp.spatial_bottom(moved) + wp.cross(
        wp.spatial_top(moved), position[i] - subtree_com[world, root_of[body]]
    )
    normal = wp.vec3(frame[i][0, 0], frame[i][0, 1], frame[i][0, 2])
    velocity -= normal * wp.dot(normal, velocity)
    speed = wp.sqrt(wp.dot(velocity, velocity) + smooth * smooth)
    force = wp.vec3(0.0, (1.0 - values[world, 0]) * friction[i][0] * pressed * velocity[1] / speed, 0.0)
    torque = wp.cross(position[i] - xipos[world, body], force)
    wp.atomic_add(applied, world, body, wp.spatial_vector(force, torque))


@wp.kernel
def turning_kernel(
    cone: int,
    moving: wp.array[bool],
    still: wp.array[bool],
    values: wp.array2d[float],
    together: float,
    rolling: wp.bool,
    timestep: wp.array[float],
    body_of: wp.array[int],
    inertia: wp.array2d[wp.vec3],
    contacts: wp.array[int],
    world_of: wp.array[int],
    geom: wp.array[wp.vec2i],
    condim: wp.array[int],
    address: wp.array2d[int],
    frame: wp.array[wp.mat33],
    efc_force: wp.array2d[float],
    ximat: wp.array2d[wp.mat33],
    cvel: wp.array2d[wp.spatial_vector],
    applied: wp.array2d[wp.spatial_vector],
):
    """See `add_turning_friction`; dim the contact capacity.

    Args:
        cone: Kind of friction cone.
        moving: Shape (ngeom,).
        still: Shape (ngeom,).
        values: Shape (N, 1).
        together: Contacts that together stop the body in one step at most.
        rolling: Whether across the normal, else about it.
        timestep: [s], shape (1,) or (N,).
        body_of: Body of each geom, shape (ngeom,).
        inertia: Principal inertias [kg m^2], shape (1 or N, nbody).
        contacts: Contacts found in all worlds, shape (1,).
        world_of: World of each contact, shape (capacity,).
        geom: Its two geoms, shape (capacity,).
        condim: Its dimensions, shape (capacity,).
        address: Its constraint rows, -1 where it is not active, shape (capacity, rows).
        frame: Its frame, normal first, shape (capacity,).
        efc_force: Forces of the constraint rows, shape (N, rows).
        ximat: Principal axes of inertia, shape (N, nbody).
        cvel: Angular and linear velocities of bodies, shape (N, nbody).
        applied: Forces and torques on bodies, shape (N, nbody), added to.
    """
    i = wp.tid()
    if i >= contacts[0]:
        return
    mine = own_geom(geom[i], moving, still)
    if address[i, 0] < 0 or mine < 0:
        return
    world = world_of[i]
    pressed = normal_force(cone, condim[i], address[i, 0], efc_force[world])
    body = body_of[mine]
    spin = wp.spatial_top(cvel[world, body])
    normal = wp.vec3(frame[i][0, 0], frame[i][0, 1], frame[i][0, 2])
    about = normal * wp.dot(normal, spin)
    if rolling:
        about = spin - about
    rate = wp.length(about)
    if rate <= 0.0:
        return
    axis = about / rate
    along = wp.transpose(ximat[world, body]) @ axis
    i3 = inertia[world % inertia.shape[0], body]
    eased = along[0] * along[0] / i3[0] + along[1] * along[1] / i3[1] + along[2] * along[2] / i3[2]
    stopping = rate / (together * timestep[world % timestep.shape[0]] * eased)
    torque = wp.min(wp.max(values[world, 0], 0.0) * pressed, stopping)
    wp.atomic_add(applied, world, body, wp.spatial_vector(wp.vec3(0.0), -torque * axis))


@wp.kernel
def adhesion_kernel(
    geom: wp.array[int],
    point: wp.array[wp.vec3],
    rounded: wp.array[bool],
    still: wp.array[int],
    values: wp.array2d[float],
    gap: float,
    kind: wp.array[int],
    size: wp.array2d[wp.vec3],
    body_of: wp.array[int],
    time: wp.array[float],
    position: wp.array2d[wp.vec3],
    frame: wp.array2d[wp.mat33],
    xipos: wp.array2d[wp.vec3],
    applied: wp.array2d[wp.spatial_vector],
):
    """See `add_adhesion`; dim (N, P, n).

    Args:
        geom: Shape (P,).
        point: Shape (P,).
        rounded: Shape (P,).
        still: Shape (n,).
        values: Shape (N, 1).
        gap: [m].
        kind: Shape (ngeom,).
        size: Shape (1 or N, ngeom).
        body_of: Body of each geom, shape (ngeom,).
        time: [s], shape (N,).
        position: Of geoms [m], shape (N, ngeom).
        frame: Of geoms, shape (N, ngeom).
        xipos: Centres of mass [m], shape (N, nbody).
        applied: Forces and torques on bodies, shape (N, nbody), added to.
    """
    world, i, k = wp.tid()
    pulled = values[world, 0]
    if pulled <= 0.0 or time[world] == 0.0:
        return
    mine = geom[i]
    ground = still[k]
    row = world % size.shape[0]
    place = position[world, mine] + frame[world, mine] * point[i]
    axes = frame[world, ground]
    local = wp.transpose(axes) * (place - position[world, ground])
    height = local[2]
    up = wp.vec3(0.0, 0.0, 1.0)
    if kind[ground] != PLANE:
        beyond = wp.vec3(wp.abs(local[0]), wp.abs(local[1]), wp.abs(local[2])) - size[row, ground]
        height = wp.max(beyond)
        outside = int(beyond[0] > 0.0) + int(beyond[1] > 0.0) + int(beyond[2] > 0.0)
        if outside > 1:
            return
        up = wp.vec3(0.0, 0.0, wp.sign(local[2]))
        if beyond[0] >= beyond[1] and beyond[0] >= beyond[2]:
            up = wp.vec3(wp.sign(local[0]), 0.0, 0.0)
        elif beyond[1] >= beyond[2]:
            up = wp.vec3(0.0, wp.sign(local[1]), 0.0)
    radius = wp.where(rounded[i], size[row, mine][0], 0.0)
    if height - radius >= gap:
        return
    normal = axes * up
    body = body_of[mine]
    force = -pulled * normal
    torque = wp.cross(place - radius * normal - xipos[world, body], force)
    wp.atomic_add(applied, world, body, wp.spatial_vector(force, torque))
