"""Bodies of a nominal scene, with the world's values, as URDF. MuJoCo reads the text and simulates nothing here."""

from __future__ import annotations

from xml.etree import ElementTree

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.independent.foreign.rig import ForeignRig, Physics

JOINTS = {mujoco.mjtJoint.mjJNT_HINGE: "revolute", mujoco.mjtJoint.mjJNT_SLIDE: "prismatic"}
FAR = 100.0
"""Limit of joints [rad or m], never met."""


def true_bodies(rig: ForeignRig, physics: Physics) -> mujoco.MjModel:
    """Return bodies, joints and shapes as they are in the world."""
    model = mujoco.MjModel.from_xml_string(rig.text.format(**physics.values))
    body = model.body(rig.body).id
    model.body_mass[body] *= physics.mass
    model.body_inertia[body] *= physics.mass * physics.inertia
    model.body_ipos[body] += physics.center
    shapes = model.geom_bodyid == body
    model.geom_size[shapes] *= physics.size
    model.geom_pos[shapes] *= physics.size
    return model


def roots(model: mujoco.MjModel) -> list[int]:
    """Return the bodies whose parent is the world."""
    return [b for b in range(1, model.nbody) if model.body_parentid[b] == 0]


def is_free(model: mujoco.MjModel, body: int) -> bool:
    """Return whether a body has a free joint."""
    joint = model.body_jntadr[body]
    return joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE


def urdf(model: mujoco.MjModel, root: int) -> str:
    """Return a body and all that hangs on it; its base link is the body if that is free, and else the world."""
    robot = ElementTree.Element("robot", name=model.body(root).name)
    if not is_free(model, root):
        base = ElementTree.SubElement(ElementTree.SubElement(robot, "link", name="base"), "inertial")
        ElementTree.SubElement(base, "mass", value="0")
        ElementTree.SubElement(base, "inertia", dict.fromkeys(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), "0"))
    for body in range(root, model.nbody):
        if model.body_rootid[body] != root:
            continue
        _link(robot, model, body)
        if not is_free(model, body):
            _joint(robot, model, body)
    return ElementTree.tostring(robot, encoding="unicode")


def _link(robot: ElementTree.Element, model: mujoco.MjModel, body: int) -> None:
    """Add a body with its mass and the shapes that touch others."""
    link = ElementTree.SubElement(robot, "link", name=model.body(body).name)
    inertial = ElementTree.SubElement(link, "inertial")
    _origin(inertial, model.body_ipos[body], model.body_iquat[body])
    ElementTree.SubElement(inertial, "mass", value=_text(model.body_mass[body]))
    ixx, iyy, izz = map(_text, model.body_inertia[body])
    ElementTree.SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")
    for geom in np.flatnonzero((model.geom_bodyid == body) & (model.geom_contype > 0)):
        collision = ElementTree.SubElement(link, "collision")
        _origin(collision, model.geom_pos[geom], model.geom_quat[geom])
        shape, size = ElementTree.SubElement(collision, "geometry"), model.geom_size[geom]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
            ElementTree.SubElement(shape, "sphere", radius=_text(size[0]))
        elif model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
            ElementTree.SubElement(shape, "box", size=_text(2 * size))
        else:
            raise ValueError(f"the shape of {model.geom(geom).name} is neither a sphere nor a box")


def _joint(robot: ElementTree.Element, model: mujoco.MjModel, body: int) -> None:
    """Add the joint of a body, without friction and damping."""
    number, parent = model.body_jntadr[body], model.body_parentid[body]
    kind = JOINTS[mujoco.mjtJoint(model.jnt_type[number])]
    joint = ElementTree.SubElement(robot, "joint", name=model.joint(number).name, type=kind)
    _origin(joint, model.body_pos[body], model.body_quat[body])
    ElementTree.SubElement(joint, "parent", link=model.body(parent).name if parent else "base")
    ElementTree.SubElement(joint, "child", link=model.body(body).name)
    ElementTree.SubElement(joint, "axis", xyz=_text(model.jnt_axis[number]))
    ElementTree.SubElement(joint, "limit", lower=str(-FAR), upper=str(FAR), effort="1e6", velocity="1e6")
    ElementTree.SubElement(joint, "dynamics", damping="0", friction="0")


def _origin(element: ElementTree.Element, position: np.ndarray, quaternion: np.ndarray) -> None:
    """Add a pose, given a quaternion wxyz."""
    angles = Rotation.from_quat(quaternion, scalar_first=True).as_euler("xyz")
    ElementTree.SubElement(element, "origin", xyz=_text(position), rpy=_text(angles))


def _text(value: float | np.ndarray) -> str:
    return " ".join(f"{x:.12g}" for x in np.atleast_1d(value))
