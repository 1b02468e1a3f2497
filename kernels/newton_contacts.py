"""Contacts of spheres for Newton's semi-implicit solver, with normals that carry gradients.

Newton's own collision pipeline records nothing on a tape: gradients with respect to shapes are zero through it. Here
the pairs are fixed, and one launch a step writes the contact points and normals of all pairs from the poses of the
bodies, differentiably; pairs that are apart cost a thread and give no force. The first body of a pair has the sphere.

With c the sphere's centre, p the nearest point of the other shape and n = (c - p) / |c - p|, the gap is n.(c - p) minus
both radii. The other shape is a point with a radius (a sphere, or the nearest point of a capsule's axis) or a surface
(plane, box, cylinder). Where the centre lies within a box or a cylinder, p and n are those of the nearest face.

A damper that acts in full at the first touch makes the motion jump with the step in which that happens, which no
gradient sees. So damping grows with the depth, up to its full value at `onset`.

Newton expects the normal from the first body to the second, -n, and takes material from shapes of bodies; stiffness,
damping and friction are given for each contact, the shapes' friction being 1.
"""

from __future__ import annotations

import warp as wp

PLANE, SPHERE, CAPSULE, CYLINDER, BOX = 0, 2, 3, 5, 6
"""Kinds of the other shape: numbers of `mujoco.mjtGeom`; a sphere is one of the fitted ones too."""
KINDS = (PLANE, SPHERE, CAPSULE, CYLINDER, BOX)
SPHERE_FRICTION, SHAPE_FRICTION, LARGER_FRICTION = 0, 1, 2
"""Whose friction counts: the sphere's, the other shape's, or the larger of both (MuJoCo's rule without priority)."""

_PLANE = wp.constant(PLANE)
_CAPSULE = wp.constant(CAPSULE)
_CYLINDER = wp.constant(CYLINDER)
_BOX = wp.constant(BOX)
_OWN = wp.constant(SPHERE_FRICTION)
_OTHER = wp.constant(SHAPE_FRICTION)
_TINY = wp.constant(1.0e-9)


@wp.func
def unit_vector(difference: wp.vec3):
    """Return the unit vector along a difference, z where that is zero."""
    size = wp.length(difference)
    if size > _TINY:
        return difference / size
    return wp.vec3(0.0, 0.0, 1.0)


@wp.func
def box_surface(centre: wp.vec3, half: wp.vec3):
    """Return the point of a box's surface that counts for a centre, and the normal there, both in the box's frame."""
    point = wp.vec3(
        wp.clamp(centre[0], -half[0], half[0]),
        wp.clamp(centre[1], -half[1], half[1]),
        wp.clamp(centre[2], -half[2], half[2]),
    )
    apart = centre - point
    if wp.length(apart) > _TINY:
        return point, unit_vector(apart)
    x = half[0] - wp.abs(centre[0])
    y = half[1] - wp.abs(centre[1])
    z = half[2] - wp.abs(centre[2])
    if x <= y and x <= z:
        side = wp.sign(centre[0])
        return wp.vec3(side * half[0], centre[1], centre[2]), wp.vec3(side, 0.0, 0.0)
    if y <= z:
        side = wp.sign(centre[1])
        return wp.vec3(centre[0], side * half[1], centre[2]), wp.vec3(0.0, side, 0.0)
    side = wp.sign(centre[2])
    return wp.vec3(centre[0], centre[1], side * half[2]), wp.vec3(0.0, 0.0, side)


@wp.func
def cylinder_surface(centre: wp.vec3, radius: float, half: float):
    """Return the point of a cylinder's surface that counts for a centre, and the normal there, in its frame."""
    across = wp.vec3(centre[0], centre[1], 0.0)
    size = wp.length(across)
    outward = wp.vec3(1.0, 0.0, 0.0)
    if size > _TINY:
        outward = across / size
    point = outward * wp.min(size, radius) + wp.vec3(0.0, 0.0, wp.clamp(centre[2], -half, half))
    apart = centre - point
    if wp.length(apart) > _TINY:
        return point, unit_vector(apart)
    if radius - size <= half - wp.abs(centre[2]):
        return outward * radius + wp.vec3(0.0, 0.0, centre[2]), outward
    side = wp.sign(centre[2])
    return across + wp.vec3(0.0, 0.0, side * half), wp.vec3(0.0, 0.0, side)


@wp.kernel
def gather_contacts(
    segments: int,
    sphere: wp.array(dtype=int),
    other: wp.array(dtype=int),
    rule: wp.array(dtype=int),
    geom_radius: wp.array(dtype=float),
    geom_friction: wp.array(dtype=float),
    base_stiffness: wp.array(dtype=float),
    base_damping: wp.array(dtype=float),
    position: wp.array2d(dtype=wp.vec3),
    radius: wp.array2d(dtype=float),
    friction: wp.array2d(dtype=float),
    friction_scale: wp.array(dtype=float),
    stiffness_scale: wp.array(dtype=float),
    point0: wp.array(dtype=wp.vec3),
    margin0: wp.array(dtype=float),
    margin1: wp.array(dtype=float),
    stiffness: wp.array(dtype=float),
    damping: wp.array(dtype=float),
    mu: wp.array(dtype=float),
):
    """Write what of the contacts stays the same over a rollout; one thread a world and pair.

    World w is candidate w // segments. Damping grows with the root of the stiffness, so that bounces stay alike.

    Args:
        segments: worlds of one candidate.
        sphere: the pair's sphere, shape (C,).
        other: the other fitted sphere, -1 where it is a geom, shape (C,).
        rule: whose friction counts, shape (C,).
        geom_radius: radius of a capsule or of a sphere that is not fitted [m], shape (C,).
        geom_friction: friction of the other shape where it is not a fitted sphere [-], shape (C,).
        base_stiffness: [N/m], shape (C,).
        base_damping: [N s/m], shape (C,).
        position: sphere centres [m], body frame, shape (P, S).
        radius: radii [m], shape (P, S).
        friction: friction of the spheres [-], shape (P, S).
        friction_scale: factor on all friction, shape (P,).
        stiffness_scale: factor on all stiffness, shape (P,).
        point0: written, as `newton.Contacts` has it, shape (W * C,).
        margin0: likewise.
        margin1: likewise.
        stiffness: likewise.
        damping: likewise.
        mu: likewise.
    """
    w, c = wp.tid()
    p = w // segments
    i = w * sphere.shape[0] + c
    s = sphere[c]
    point0[i] = position[p, s]
    margin0[i] = radius[p, s]
    other_friction = geom_friction[c]
    margin = geom_radius[c]
    if other[c] >= 0:
        other_friction = friction[p, other[c]]
        margin = radius[p, other[c]]
    margin1[i] = margin
    chosen = wp.max(friction[p, s], other_friction)
    if rule[c] == _OWN:
        chosen = friction[p, s]
    if rule[c] == _OTHER:
        chosen = other_friction
    mu[i] = chosen * friction_scale[p]
    stiffness[i] = base_stiffness[c] * stiffness_scale[p]
    damping[i] = base_damping[c] * wp.sqrt(stiffness_scale[p])


@wp.kernel
def write_contacts(
    bodies: int,
    segments: int,
    body0: wp.array(dtype=int),
    body1: wp.array(dtype=int),
    other: wp.array(dtype=int),
    kind: wp.array(dtype=int),
    frame: wp.array(dtype=wp.transform),
    size: wp.array(dtype=wp.vec3),
    position: wp.array2d(dtype=wp.vec3),
    point0: wp.array(dtype=wp.vec3),
    margin0: wp.array(dtype=float),
    margin1: wp.array(dtype=float),
    full_damping: wp.array(dtype=float),
    onset: float,
    body_q: wp.array(dtype=wp.transform),
    point1: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    damping: wp.array(dtype=float),
):
    """Write the contact points and normals of one step; one thread a world and pair.

    Args:
        bodies: bodies of a world.
        segments: worlds of one candidate.
        body0: the sphere's body within a world, shape (C,).
        body1: the other shape's body, shape (C,).
        other: the other fitted sphere, -1 where it is a geom, shape (C,).
        kind: kind of the other shape, shape (C,).
        frame: pose of the other geom in its body, identity for fitted spheres, shape (C,).
        size: MuJoCo's size of the other geom [m], shape (C,).
        position: sphere centres [m], body frame, shape (P, S).
        point0: centres of the pairs' spheres [m], body frame, shape (W * C,).
        margin0: radii of these spheres [m], shape (W * C,).
        margin1: radii of the other shapes [m], 0 for surfaces, shape (W * C,).
        full_damping: damping beyond the onset [N s/m], shape (W * C,).
        onset: depth at which damping is full [m].
        body_q: poses of all bodies, shape (W * bodies,).
        point1: nearest points [m], frame of the second body, written, shape (W * C,).
        normal: from the first body to the second, world frame, written, shape (W * C,).
        damping: at this step [N s/m], written, shape (W * C,).
    """
    w, c = wp.tid()
    i = w * body0.shape[0] + c
    pose = body_q[w * bodies + body1[c]]
    world = wp.transform_point(body_q[w * bodies + body0[c]], point0[i])
    local = wp.transform_point(wp.transform_inverse(pose * frame[c]), world)
    half = size[c]
    point = wp.vec3(0.0, 0.0, 0.0)
    if other[c] >= 0:
        point = position[w // segments, other[c]]
    outward = unit_vector(local - point)
    if kind[c] == _PLANE:
        point = wp.vec3(local[0], local[1], 0.0)
        outward = wp.vec3(0.0, 0.0, 1.0)
    if kind[c] == _CAPSULE:
        point = wp.vec3(0.0, 0.0, wp.clamp(local[2], -half[1], half[1]))
        outward = unit_vector(local - point)
    if kind[c] == _BOX:
        point, outward = box_surface(local, half)
    if kind[c] == _CYLINDER:
        point, outward = cylinder_surface(local, half[0], half[1])
    point1[i] = wp.transform_point(frame[c], point)
    normal[i] = -wp.transform_vector(pose, wp.transform_vector(frame[c], outward))
    depth = margin0[i] + margin1[i] - wp.dot(outward, local - point)
    damping[i] = full_damping[i] * wp.clamp(depth / onset, 0.0, 1.0)


@wp.kernel
def replay_bodies(
    bodies: int,
    segments: int,
    step: int,
    replayed: wp.array(dtype=int),
    pose: wp.array3d(dtype=wp.transform),
    velocity: wp.array3d(dtype=wp.spatial_vector),
    body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
):
    """Put the replayed bodies where they are at one step; one thread a world and body.

    Args:
        bodies: bodies of a world.
        segments: worlds of one candidate; world w replays segment w % segments.
        step: the step.
        replayed: the bodies within a world, shape (B,).
        pose: their poses, shape (K + 1, segments, B).
        velocity: their velocities, linear then angular, world frame [m/s, rad/s], shape (K + 1, segments, B).
        body_q: poses of all bodies, written, shape (W * bodies,).
        body_qd: velocities of all bodies, written, shape (W * bodies,).
    """
    w, b = wp.tid()
    body_q[w * bodies + replayed[b]] = pose[step, w % segments, b]
    body_qd[w * bodies + replayed[b]] = velocity[step, w % segments, b]


@wp.kernel
def scale_masses(
    bodies: int,
    segments: int,
    moving: wp.array(dtype=int),
    scale: wp.array2d(dtype=float),
    mass: wp.array(dtype=float),
    inertia: wp.array(dtype=wp.mat33),
    body_mass: wp.array(dtype=float),
    body_inertia: wp.array(dtype=wp.mat33),
    body_inv_mass: wp.array(dtype=float),
    body_inv_inertia: wp.array(dtype=wp.mat33),
):
    """Scale mass and inertia of the simulated bodies; one thread a world and body.

    Args:
        bodies: bodies of a world.
        segments: worlds of one candidate.
        moving: the simulated bodies within a world, shape (B,).
        scale: factors on mass and inertia, shape (P, B).
        mass: their masses [kg], shape (B,).
        inertia: their inertias [kg m^2], body axes, shape (B,).
        body_mass: of all bodies, written, shape (W * bodies,).
        body_inertia: likewise.
        body_inv_mass: likewise.
        body_inv_inertia: likewise.
    """
    w, b = wp.tid()
    factor = scale[w // segments, b]
    i = w * bodies + moving[b]
    scaled = inertia[b] * factor
    body_mass[i] = mass[b] * factor
    body_inv_mass[i] = 1.0 / (mass[b] * factor)
    body_inertia[i] = scaled
    body_inv_inertia[i] = wp.inverse(inertia[b]) / factor
