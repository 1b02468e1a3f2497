"""Which spheres a fit may move, and which must be collidable while it searches (paper, appendix A)."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial import KDTree

from concent_warp.model import Model
from concent_warp.scene.spheres.contact_geometry import ContactGeometry


def robot_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Return which bodies an actuator moves, directly or by carrying them, shape (nbody,) bool.

    Joints driven through a tendon or coupled by an equality to a driven joint count as driven.
    """
    driven: set[int] = set()
    for a in range(model.nu):
        target, kind = int(model.actuator_trnid[a, 0]), int(model.actuator_trntype[a])
        if kind in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
            driven.add(target)
        elif kind == int(mujoco.mjtTrn.mjTRN_TENDON):
            start, count = model.tendon_adr[target], model.tendon_num[target]
            wraps = range(start, start + count)
            driven |= {int(model.wrap_objid[w]) for w in wraps if model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT}
    for e in range(model.neq):
        if int(model.eq_type[e]) == int(mujoco.mjtEq.mjEQ_JOINT):
            pair = {int(model.eq_obj1id[e]), int(model.eq_obj2id[e])} - {-1}
            driven |= pair if pair & driven else set()
    result = np.zeros(model.nbody, dtype=bool)
    for body in range(1, model.nbody):
        joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
        result[body] = result[model.body_parentid[body]] or any(j in driven for j in joints)
    return result


def touched_spheres(touched: np.ndarray, sphere_geom: np.ndarray, robot: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split the spheres in contact by what they touched.

    Args:
        touched: Contacts of one variant by geom and other body, shape (ngeom, nbody) bool.
        sphere_geom: Geom id of each sphere, -1 where it is not collidable, shape (S,).
        robot: Which bodies belong to the robot, shape (nbody,) bool.

    Returns:
        Spheres that touched anything but the robot, and spheres that the robot touched, each (S,) bool.
    """
    by_sphere = np.where(sphere_geom[:, None] >= 0, touched[sphere_geom], False)
    return np.any(by_sphere[:, ~robot], axis=1), np.any(by_sphere[:, robot], axis=1)


def with_neighbours(geometry: ContactGeometry, spheres: np.ndarray, k: int) -> np.ndarray:
    """Return the spheres (S,) bool together with the k nearest neighbours of each on the same body."""
    result = spheres.copy()
    for body in geometry.bodies:
        rows = geometry.of(body)
        chosen = rows[spheres[rows]]
        if len(chosen) and k > 0:
            _, near = KDTree(geometry.position[rows]).query(geometry.position[chosen], min(k + 1, len(rows)))
            result[rows[np.unique(near)]] = True
    return result


def spheres_near(model: Model, states: np.ndarray, reach: float) -> np.ndarray:
    """Return which bodies each sphere comes near, geometrically, in any of the states, shape (S, nbody) bool.

    Args:
        model: Model with contact geometry.
        states: Generalised positions, shape (T, nq).
        reach: Distance between the surfaces of the sphere and of a geom of the body [m].
    """
    assert model.geometry is not None
    spec = model.spec()
    names = model.geometry.names()
    spheres = set(names)
    for geom in spec.geoms:
        if geom.name in spheres:
            geom.gap = reach  # contacts within margin + gap are found, which add up over the two geoms of a pair
    compiled = spec.compile()
    sphere = np.full(compiled.ngeom, -1)
    sphere[[compiled.geom(name).id for name in names]] = np.arange(len(names))
    data = mujoco.MjData(compiled)
    result = np.zeros((len(names), compiled.nbody), dtype=bool)
    for qpos in states:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(compiled, data)
        mujoco.mj_collision(compiled, data)
        pairs = data.contact.geom[data.contact.dist <= reach].T
        for one, other in (pairs, pairs[::-1]):
            is_sphere = sphere[one] >= 0
            result[sphere[one[is_sphere]], compiled.geom_bodyid[other[is_sphere]]] = True
    return result
