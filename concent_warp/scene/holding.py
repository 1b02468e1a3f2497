"""Dry friction that holds, and acts alike in all directions, where a scene leaves MuJoCo's constants at their defaults.

MuJoCo's friction is a soft constraint. At its default constants a joint with `frictionloss`, or a body on a slope,
creeps under load, where a real one stays at rest; and the friction of contacts is limited by a pyramid, so that a body
that slides meets more or less of it by direction, and presses softer on what it slides on.
"""

from __future__ import annotations

from typing import Literal
from xml.etree import ElementTree

import mujoco
import numpy as np

from concent_warp.scene.scene import Scene
from concent_warp.scene.touchable import touchable_pairs

Holding = Literal["joints", "cones", "contacts"]
"""Where dry friction acts; `cones` are those of contacts, which are pyramids by default."""
TIME_CONSTANT_STEPS = 1.5
"""Time constant of the friction of joints, in time steps; MuJoCo takes at least 2 where it is asked to be safe."""
FRICTION_IMPEDANCE = 0.99
"""Impedance of the friction of joints [-]."""
IMPRATIO = 10.0
"""Impedance of friction over that of the normal force in contacts [-]."""


def with_holding_friction(scene: Scene, where: Holding) -> Scene | None:
    """Return a scene with dry friction that holds in joints or contacts; None where that changes nothing.

    Constants that the MJCF sets stay: of a joint, its class or all joints, and of contacts. Contacts hold by elliptic
    cones only.
    """
    root, m = ElementTree.fromstring(scene.xml), scene.model
    if where == "joints":
        if not (m.dof_frictionloss > 0).any():
            return None
        for name, value in joint_constants(scene).items():
            _set_default(root, name, value)
    else:
        constants = contact_constants(scene, where)
        if not constants:
            return None
        option = next(reversed(root.findall("option")), None)
        if option is None:
            option = ElementTree.Element("option")
            root.insert(0, option)
        for name, value in constants.items():
            option.set(name, value)
    holding = Scene(ElementTree.tostring(root, encoding="unicode"), scene.source)
    return None if where == "joints" and _same_joints(holding.model, m) else holding


def contact_constants(scene: Scene, where: Holding) -> dict[str, str]:
    """Return MJCF options of elliptic cones, and for "contacts" of cones that hold; none where that changes nothing."""
    options, m = ElementTree.fromstring(scene.xml).findall("option"), scene.model
    given = {name for option in options for name in option.attrib}
    pyramids = m.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC
    if pyramids and ("cone" in given or not (m.npair or touchable_pairs(m).any())):
        return {}
    if not (pyramids or where == "contacts"):
        return {}
    if where == "contacts" and ("impratio" in given or m.opt.impratio != 1.0):
        return {}
    impratio = {"impratio": f"{IMPRATIO:g}"} if where == "contacts" else {}
    return {**({"cone": "elliptic"} if pyramids else {}), **impratio}


def joint_constants(scene: Scene) -> dict[str, str]:
    """Return MJCF attributes of joints with which the friction of a scene's joints holds."""
    steps = TIME_CONSTANT_STEPS * scene.model.opt.timestep
    impedance = f"{FRICTION_IMPEDANCE:g}"
    return {"solreffriction": f"{steps:g} 1", "solimpfriction": f"{impedance} {impedance} 0.001"}


def _set_default(root: ElementTree.Element, name: str, value: str) -> None:
    """Set an attribute of all joints that neither they, their classes nor other defaults set."""
    tops = root.findall("default")
    if any(name in joint.attrib for top in tops for joint in top.findall("joint")):
        return
    if not tops:
        tops = [ElementTree.Element("default")]
        root.insert(0, tops[0])
    joint = tops[0].find("joint")
    if joint is None:
        joint = ElementTree.SubElement(tops[0], "joint")
    joint.set(name, value)


def _same_joints(one: mujoco.MjModel, other: mujoco.MjModel) -> bool:
    """Return whether the friction of all joints has the same constants."""
    has_friction = other.dof_frictionloss > 0
    pairs = ((one.dof_solref, other.dof_solref), (one.dof_solimp, other.dof_solimp))
    return all(np.array_equal(a[has_friction], b[has_friction]) for a, b in pairs)
