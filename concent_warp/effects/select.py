"""Selections of model elements for effects: driven joints, free bodies, fingers, static geoms."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np

from concent_warp.scene.sensor_frame import sensor_frame
from concent_warp.scene.touchable import touchable_pairs

JOINT = mujoco.mjtJoint
SENSOR = mujoco.mjtSensor
SINGLE = (int(JOINT.mjJNT_HINGE), int(JOINT.mjJNT_SLIDE))
BEARINGS = (*SINGLE, int(JOINT.mjJNT_BALL))
POSES = (int(SENSOR.mjSENS_FRAMEPOS), int(SENSOR.mjSENS_FRAMEQUAT))
PARALLEL = 1e-3
"""Part of an axis across others below which they are parallel [-]."""
JOINTS = (int(SENSOR.mjSENS_JOINTPOS), int(SENSOR.mjSENS_JOINTVEL))
FORCES = (
    *(int(SENSOR.mjSENS_FORCE), int(SENSOR.mjSENS_TORQUE), int(SENSOR.mjSENS_TOUCH)),
    *(int(SENSOR.mjSENS_ACTUATORFRC), int(SENSOR.mjSENS_JOINTACTFRC)),
)
"""Cells of force and torque, and drives' currents."""
INERTIAL = (int(SENSOR.mjSENS_GYRO), int(SENSOR.mjSENS_ACCELEROMETER), int(SENSOR.mjSENS_VELOCIMETER))
"""What an inertial measurement unit reads."""


def element_name(m: mujoco.MjModel, kind: mujoco.mjtObj, i: int) -> str:
    """Return the name of an element, empty where it has none."""
    return mujoco.mj_id2name(m, kind, int(i)) or ""


def joints_by_type(
    m: mujoco.MjModel, among: Iterable[int] | None = None, kinds: tuple[int, ...] = SINGLE
) -> tuple[tuple[str, ...], ...]:
    """Return the names of hinges, then of slides, or of other kinds; a selection without members is left out."""
    ids = range(m.njnt) if among is None else sorted(among)
    groups = [
        tuple(n for j in ids if int(m.jnt_type[j]) == kind and (n := element_name(m, mujoco.mjtObj.mjOBJ_JOINT, j)))
        for kind in kinds
    ]
    return tuple(group for group in groups if group)


def driven_joints(m: mujoco.MjModel, actuator: int) -> list[int]:
    """Return the joints that an actuator drives, directly or through a tendon that adds joints up."""
    kind, target = m.actuator_trntype[actuator], int(m.actuator_trnid[actuator, 0])
    if kind in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
        return [target]
    if kind == int(mujoco.mjtTrn.mjTRN_TENDON):
        first = m.tendon_adr[target]
        wraps = range(first, first + m.tendon_num[target])
        return [int(m.wrap_objid[w]) for w in wraps if m.wrap_type[w] == int(mujoco.mjtWrap.mjWRAP_JOINT)]
    return []


def free_bodies(m: mujoco.MjModel) -> list[int]:
    """Return the bodies with a free joint."""
    return [int(m.jnt_bodyid[j]) for j in range(m.njnt) if m.jnt_type[j] == int(JOINT.mjJNT_FREE)]


def placing_joints(m: mujoco.MjModel) -> list[int]:
    """Return the joints that only place a body: slides and hinges in place of a free joint, as in a plane.

    These are two slides or more on a body, with its other joints, without drive, coupling, tendon, friction, damping,
    spring, armature or limit: no bearing has such axes in one body, and what acts on it does so by its contacts and its
    mass.
    """
    driven = [j for a in range(m.nu) for j in driven_joints(m, a)]
    pulled = m.wrap_objid[m.wrap_type == int(mujoco.mjtWrap.mjWRAP_JOINT)]
    coupled = m.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)
    bound = m.jnt_limited.astype(bool) | (m.jnt_stiffness != 0)
    bound |= np.isin(np.arange(m.njnt), [*driven, *pulled, *m.eq_obj1id[coupled], *m.eq_obj2id[coupled]])
    resisted = (m.dof_damping != 0) | (m.dof_frictionloss != 0) | (m.dof_armature != 0)
    np.logical_or.at(bound, m.dof_jntid, resisted)
    slides, found = m.jnt_type == int(JOINT.mjJNT_SLIDE), []
    for body in np.unique(m.jnt_bodyid):
        mine = np.flatnonzero(m.jnt_bodyid == body)
        if slides[mine].sum() >= 2 and not bound[mine].any():
            found += mine.tolist()
    return found


def unguided_bodies(m: mujoco.MjModel) -> list[int]:
    """Return the bodies that no bearing guides: those with a free joint, or with joints that only place them."""
    return [*free_bodies(m), *dict.fromkeys(int(m.jnt_bodyid[j]) for j in placing_joints(m))]


def unguided_body_targets(m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
    """Return one selection for each such body that has a name."""
    return tuple((n,) for b in unguided_bodies(m) if (n := element_name(m, mujoco.mjtObj.mjOBJ_BODY, b)))


def fingers(m: mujoco.MjModel) -> list[int]:
    """Return the bodies of a parallel gripper's fingers: neighbours that slide against the body which carries both."""
    sliding = [
        int(m.jnt_bodyid[j])
        for j in range(m.njnt)
        if m.jnt_type[j] == int(JOINT.mjJNT_SLIDE) and m.body_jntnum[m.jnt_bodyid[j]] == 1
    ]
    parents = [int(m.body_parentid[b]) for b in sliding]
    return [b for b, parent in zip(sliding, parents, strict=True) if parent and parents.count(parent) > 1]


def gripper_actuators(m: mujoco.MjModel) -> list[int]:
    """Return the actuators that drive fingers."""
    found = set(fingers(m))
    return [a for a in range(m.nu) if any(int(m.jnt_bodyid[j]) in found for j in driven_joints(m, a))]


def arm_actuators(m: mujoco.MjModel) -> tuple[str, ...]:
    """Return the names of the actuators of single joints that are not fingers."""
    gripper = set(gripper_actuators(m))
    return tuple(
        n
        for a in range(m.nu)
        if a not in gripper and driven_joints(m, a) and (n := element_name(m, mujoco.mjtObj.mjOBJ_ACTUATOR, a))
    )


def is_thruster(m: mujoco.MjModel, actuator: int) -> bool:
    """Return whether an actuator pushes or turns a body at a site, as a rotor does."""
    return m.actuator_trntype[actuator] == int(mujoco.mjtTrn.mjTRN_SITE)


def thrusters(m: mujoco.MjModel) -> tuple[str, ...]:
    """Return the names of the actuators that push or turn a body at a site."""
    return tuple(
        n for a in range(m.nu) if is_thruster(m, a) and (n := element_name(m, mujoco.mjtObj.mjOBJ_ACTUATOR, a))
    )


def each_of_several(selections: Iterable[tuple[str, ...]]) -> tuple[tuple[str, ...], ...]:
    """Return each element of the selections that have several, as a selection of its own."""
    return tuple((name,) for names in selections if len(names) > 1 for name in names)


def servo_gain(m: mujoco.MjModel, actuator: int) -> float:
    """Return the position gain of a position-controlled actuator, 0 for another."""
    gain, bias = float(m.actuator_gainprm[actuator, 0]), float(m.actuator_biasprm[actuator, 1])
    affine = m.actuator_biastype[actuator] == int(mujoco.mjtBias.mjBIAS_AFFINE)
    return gain if affine and gain > 0 and abs(gain + bias) <= 1e-6 * gain else 0.0


def servo_stiffness(m: mujoco.MjModel, joints: np.ndarray) -> np.ndarray:
    """Return the stiffness [N m/rad or N/m] by which position-controlled drives hold each joint, shape (n,)."""
    held = np.zeros(m.njnt)
    for a in range(m.nu):
        if m.actuator_trntype[a] == int(mujoco.mjtTrn.mjTRN_JOINT):
            held[m.actuator_trnid[a, 0]] += servo_gain(m, a) * m.actuator_gear[a, 0] ** 2
    return held[joints]


def robot_bodies(m: mujoco.MjModel) -> list[int]:
    """Return the bodies that an actuated joint carries."""
    roots = {int(m.jnt_bodyid[j]) for a in range(m.nu) for j in driven_joints(m, a)}
    carried = []
    for b in range(1, m.nbody):
        above = b
        while above and above not in roots:
            above = int(m.body_parentid[above])
        if above:
            carried.append(b)
    return carried


def outermost_links(m: mujoco.MjModel) -> list[int]:
    """Return the moving bodies that carry no other moving body, but for free bodies and fingers; with fingers, what
    carries them.
    """
    free, finger = set(free_bodies(m)), set(fingers(m))
    jointed = {int(m.jnt_bodyid[j]) for j in range(m.njnt)} - free - finger
    above = set()
    for b in jointed:
        parent = int(m.body_parentid[b])
        while parent:
            above.add(parent)
            parent = int(m.body_parentid[parent])
    return sorted(jointed - above)


def moving_as_one(m: mujoco.MjModel, body: int) -> list[int]:
    """Return a body and those that are fixed to it, such as the tool or the payload on a link."""
    return [body, *(b for b in range(body + 1, m.nbody) if m.body_weldid[b] == m.body_weldid[body])]


def turning_axes(m: mujoco.MjModel, body: int) -> int:
    """Return about how many axes a body turns against the world, by joints that are not parallel: from 0 to 3."""
    data, axes, above = mujoco.MjData(m), [np.zeros(3)], int(body)
    mujoco.mj_kinematics(m, data)
    while above:
        for j in range(m.body_jntadr[above], m.body_jntadr[above] + m.body_jntnum[above]):
            if m.jnt_type[j] in (int(JOINT.mjJNT_FREE), int(JOINT.mjJNT_BALL)):
                return 3
            if m.jnt_type[j] == int(JOINT.mjJNT_HINGE):
                axes.append(data.xaxis[j].copy())
        above = int(m.body_parentid[above])
    return int(np.linalg.matrix_rank(np.array(axes), tol=PARALLEL))


def geoms_of(m: mujoco.MjModel, body: int) -> np.ndarray:
    """Return the geoms that move as one with a body, shape (n,) int."""
    return np.flatnonzero(m.body_weldid[m.geom_bodyid] == m.body_weldid[body])


def static_geoms(m: mujoco.MjModel) -> np.ndarray:
    """Return the geoms that cannot move, shape (n,) int."""
    return geoms_of(m, 0)


def surfaces(m: mujoco.MjModel, body: int) -> np.ndarray:
    """Return the colliding geoms of a body and all static colliding geoms, shape (n,) int."""
    ids = np.union1d(geoms_of(m, body), static_geoms(m))
    return ids[(m.geom_contype[ids] != 0) | (m.geom_conaffinity[ids] != 0)]


def jointed_contact_targets(m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
    """Return selections of bodies on joints that can touch one another, or what stands still: a finger and a door.

    Bodies that can touch the same are one selection. There is none where a body moves freely: what it touches, and what
    stands still, is that of its own contacts.
    """
    if unguided_bodies(m):
        return ()
    touching, body = touchable_pairs(m), m.body_weldid[m.geom_bodyid]
    group = np.arange(m.nbody)
    for one, other in np.unique(body[np.argwhere(touching)], axis=0):
        group[group == group[other]] = group[one]
    moving = [b for b in np.unique(body[touching.any(axis=0)]) if b]
    found = (
        tuple(n for b in moving if group[b] == g and (n := element_name(m, mujoco.mjtObj.mjOBJ_BODY, b)))
        for g in dict.fromkeys(int(group[b]) for b in moving)
    )
    return tuple(names for names in found if names)


def sensors_by_type(m: mujoco.MjModel, kinds: tuple[int, ...]) -> tuple[str, ...]:
    """Return the names of the sensors of some kinds."""
    return tuple(
        n
        for i in range(m.nsensor)
        if int(m.sensor_type[i]) in kinds and (n := element_name(m, mujoco.mjtObj.mjOBJ_SENSOR, i))
    )


def dof_of(m: mujoco.MjModel, joints: np.ndarray) -> np.ndarray:
    """Return the degree of freedom of each hinge or slide, shape (n,) int."""
    return m.jnt_dofadr[joints]


def dofs_of(m: mujoco.MjModel, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the degrees of freedom of hinges, slides and ball joints, shape (k,), and for each the row of its joint.

    A ball joint has three.
    """
    count = np.where(m.jnt_type[joints] == int(JOINT.mjJNT_BALL), 3, 1)
    rows = np.repeat(np.arange(len(joints)), count)
    within = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count)
    return m.jnt_dofadr[joints][rows] + within, rows


def typical_torque(m: mujoco.MjModel, joints: np.ndarray) -> np.ndarray:
    """Return the torque [N m] or force [N] that moves each joint at 10 rad/s^2 or m/s^2, shape (n,).

    Of a ball joint it is that about the axis of the largest inertia.
    """
    dofs, rows = dofs_of(m, joints)
    inertia = np.zeros(len(joints))
    np.maximum.at(inertia, rows, m.dof_M0[dofs])
    return 10.0 * inertia


def shown_dofs(m: mujoco.MjModel, sensors: Iterable[str]) -> np.ndarray:
    """Return the degrees of freedom whose positions some sensors of joints and of free bodies show, shape (n,) int."""
    found: list[int] = []
    for name in sensors:
        row = m.sensor(name).id
        kind, i = int(m.sensor_type[row]), int(m.sensor_objid[row])
        if kind == JOINTS[0]:
            found.append(int(m.jnt_dofadr[i]))
        elif kind in POSES and (joint := shown_free_joint(m, row)) is not None:
            first = int(m.jnt_dofadr[joint]) + 3 * POSES.index(kind)
            found += range(first, first + 3)
    return np.unique(np.array(found, dtype=int))


def shown_free_joint(m: mujoco.MjModel, sensor: int) -> int | None:
    """Return the free joint of the body whose position or orientation a sensor shows; None where there is none."""
    if (frame := sensor_frame(m, sensor)) is None:
        return None
    joint = int(m.body_jntadr[frame.body])
    return joint if joint >= 0 and m.jnt_type[joint] == int(JOINT.mjJNT_FREE) else None
