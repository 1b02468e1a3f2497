"""Constraints that hold where a scene leaves MuJoCo's constants at their defaults.

MuJoCo's constraints are soft. At the default constants a joint with `frictionloss`, or a body on a slope, creeps under
load, where a real one stays at rest; coupled joints and a joint at its stop give way to a load by what counts beside an
encoder's noise. The friction of contacts is limited by a pyramid, so that a body that slides meets more or less of it
by direction, and presses softer on what it slides on.
"""

from __future__ import annotations

from typing import Literal
from xml.etree import ElementTree

import mujoco
import numpy as np

from concent_warp.scene.scene import Scene
from concent_warp.scene.touchable import touchable_pairs

Holding = Literal["joints", "equalities", "limits", "cones", "contacts"]
"""Which constraints hold: the dry friction of joints, equality constraints, the limits of joints, or the friction of
contacts; `cones` are those of the latter, which are pyramids by default."""
TIME_CONSTANT_STEPS = 1.5
"""Time constant of the friction of joints, in time steps; MuJoCo takes at least 2 where it is asked to be safe."""
FRICTION_IMPEDANCE = 0.99
"""Impedance of the friction of joints [-]."""
STIFF_STEPS = 2.0
"""Time constant of equality constraints and limits of joints, in time steps: the shortest that MuJoCo takes where it is
asked to be safe, as it is by default."""
STIFF_IMPEDANCE = 0.99
"""Impedance of equality constraints and limits of joints [-]."""
IMPRATIO = 10.0
"""Impedance of friction over that of the normal force in contacts [-]."""


def with_holding_constraints(scene: Scene, where: Holding) -> Scene | None:
    """Return a scene with constraints that hold; None where that changes nothing.

    Constants that the MJCF sets stay: of a joint or an equality constraint, its class or all of them, and of contacts.
    Contacts hold by elliptic cones only.
    """
    constants = holding_constants(scene, where)
    if not constants:
        return None
    root = ElementTree.fromstring(scene.xml)
    if where in ("cones", "contacts"):
        option = next(reversed(root.findall("option")), None)
        if option is None:
            option = ElementTree.Element("option")
            root.insert(0, option)
        for name, value in constants.items():
            option.set(name, value)
    else:
        for name, value in constants.items():
            _set_default(root, "equality" if where == "equalities" else "joint", name, value)
    holding = Scene(ElementTree.tostring(root, encoding="unicode"), scene.source)
    return None if _is_same(holding.model, scene.model, where) else holding


def holding_constants(scene: Scene, where: Holding) -> dict[str, str]:
    """Return the attributes of the MJCF with which constraints of a scene hold; none where it has no such ones.

    Those of `cones` and `contacts` are options, the others defaults of joints or equality constraints.
    """
    m = scene.model
    if where in ("cones", "contacts"):
        return _contact_constants(scene, where)
    if not len(_constants(m, where)[0]):
        return {}
    steps, least = (TIME_CONSTANT_STEPS, FRICTION_IMPEDANCE) if where == "joints" else (STIFF_STEPS, STIFF_IMPEDANCE)
    ending = {"joints": "friction", "equalities": "", "limits": "limit"}[where]
    time_constant, impedance = f"{steps * m.opt.timestep:g} 1", f"{least:g} {least:g} 0.001"
    return {f"solref{ending}": time_constant, f"solimp{ending}": impedance}


def _contact_constants(scene: Scene, where: Holding) -> dict[str, str]:
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


def _set_default(root: ElementTree.Element, tag: str, name: str, value: str) -> None:
    """Set an attribute of all joints or equality constraints that neither they, their classes nor defaults set."""
    tops = root.findall("default")
    if any(name in one.attrib for top in tops for one in top.findall(tag)):
        return
    if not tops:
        tops = [ElementTree.Element("default")]
        root.insert(0, tops[0])
    default = tops[0].find(tag)
    if default is None:
        default = ElementTree.SubElement(tops[0], tag)
    default.set(name, value)


def _constants(m: mujoco.MjModel, where: Holding) -> tuple[np.ndarray, np.ndarray]:
    """Return the constants `solref`, shape (C, 2), and `solimp`, shape (C, 5), of the C constraints of a kind."""
    if where == "joints":
        return m.dof_solref[m.dof_frictionloss > 0], m.dof_solimp[m.dof_frictionloss > 0]
    if where == "equalities":
        return m.eq_solref, m.eq_solimp
    limited = m.jnt_limited.astype(bool)
    return m.jnt_solref[limited], m.jnt_solimp[limited]


def _is_same(one: mujoco.MjModel, other: mujoco.MjModel, where: Holding) -> bool:
    """Return whether all constraints of a kind have the same constants; those of contacts are never compared."""
    if where in ("cones", "contacts"):
        return False
    return all(np.array_equal(a, b) for a, b in zip(_constants(one, where), _constants(other, where), strict=True))
