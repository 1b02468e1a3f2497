"""Constants of constraints that hold, where the MJCF leaves them at their defaults."""

from __future__ import annotations

import numpy as np
import pytest

from concent_warp.scene.holding import FRICTION_IMPEDANCE, STIFF_IMPEDANCE, with_holding_constraints
from concent_warp.scene.scene import Scene

MASS = 1.2345678901
SCENE = (
    "<mujoco><option timestep='.002'{option}/>{default}<worldbody><geom type='plane' size='1 1 .1'/>"
    "<body><joint name='a' type='slide'{joint}/>"
    f"<inertial pos='0 0 0' mass='{MASS}' diaginertia='.1 .1 .1'/>"
    "<body><joint name='b' frictionloss='.2' axis='0 1 0'/><geom size='.1'/></body></body></worldbody></mujoco>"
)


def scene(joint: str = " frictionloss='1'", default: str = "", option: str = "") -> Scene:
    return Scene(SCENE.format(joint=joint, default=default, option=option))


@pytest.mark.parametrize(
    "default",
    [
        "",
        "<default/>",
        "<default><geom mass='1'/></default>",
        "<default><joint damping='3'/><default class='c'/></default>",
    ],
)
def test_friction_of_joints_holds_where_nothing_is_said_of_it(default):
    given = scene(default=default)
    found = with_holding_constraints(given, "joints")
    assert found is not None
    np.testing.assert_allclose(found.model.dof_solref, [[0.003, 1.0]] * 2)
    np.testing.assert_allclose(found.model.dof_solimp[:, :2], FRICTION_IMPEDANCE)
    for name in ("body_mass", "dof_damping", "dof_frictionloss", "dof_armature", "geom_solref", "jnt_solref"):
        np.testing.assert_array_equal(getattr(found.model, name), getattr(given.model, name))
    assert found.model.body_mass[1] == MASS
    assert with_holding_constraints(found, "joints") is None


def test_constants_that_the_mjcf_sets_stay():
    own = "solreffriction='.05 1' solimpfriction='.8 .9 .001'"
    found = with_holding_constraints(scene(joint=f" frictionloss='1' {own}"), "joints")
    assert found is not None
    np.testing.assert_allclose(found.model.dof_solref, [[0.05, 1.0], [0.003, 1.0]])
    np.testing.assert_allclose(found.model.dof_solimp[0, :2], [0.8, 0.9])
    assert with_holding_constraints(scene(default=f"<default><joint {own}/></default>"), "joints") is None
    joint, inner = " class='c' frictionloss='1'", f"<default><default class='c'><joint {own}/></default></default>"
    found = with_holding_constraints(scene(joint=joint, default=inner), "joints")
    assert found is not None
    np.testing.assert_allclose(found.model.dof_solref, [[0.05, 1.0], [0.003, 1.0]])


def test_joints_without_friction_have_nothing_to_hold_by():
    assert with_holding_constraints(Scene(scene().xml.replace("frictionloss", "damping")), "joints") is None


@pytest.mark.parametrize(
    ("option", "where", "cone", "impratio"),
    [
        (" cone='elliptic'", "contacts", 1, 10.0),
        ("", "contacts", 1, 10.0),
        ("", "cones", 1, 1.0),
        (" impratio='3'", "cones", 1, 3.0),
    ],
)
def test_contacts_hold_by_the_ratio_of_impedances_of_elliptic_cones(option, where, cone, impratio):
    found = with_holding_constraints(scene(option=option), where)
    assert found is not None
    assert (found.model.opt.cone, found.model.opt.impratio) == (cone, impratio)
    assert found.model.opt.timestep == 0.002
    np.testing.assert_array_equal(found.model.dof_solref, scene().model.dof_solref)
    assert with_holding_constraints(found, where) is None


@pytest.mark.parametrize(
    ("option", "where"),
    [
        (" cone='elliptic' impratio='3'", "contacts"),
        (" impratio='3'", "contacts"),
        (" cone='pyramidal'", "contacts"),
        (" cone='pyramidal'", "cones"),
        (" cone='elliptic'", "cones"),
    ],
)
def test_cones_of_contacts_that_the_mjcf_states_stay(option, where):
    assert with_holding_constraints(scene(option=option), where) is None


def test_scenes_without_options_have_elliptic_cones_too_unless_nothing_can_touch():
    given = Scene(scene().xml.replace("<option timestep='.002'/>", ""))
    found = with_holding_constraints(given, "cones")
    assert found is not None
    assert found.model.opt.cone == 1
    free = Scene(given.xml.replace("<geom size='.1'/>", "<geom size='.1' contype='0' conaffinity='0'/>"))
    assert with_holding_constraints(free, "cones") is None


EQUALITY = "<equality><joint joint1='a' joint2='b'{own}/></equality>"


def coupled(own: str = "", default: str = "", joint: str = "") -> Scene:
    """Return a scene with an equality constraint, and joint `a` limited."""
    given = SCENE.format(joint=f" range='-1 1'{joint}", default=default, option="")
    return Scene(given.replace("</mujoco>", f"{EQUALITY.format(own=own)}</mujoco>").replace("<mujoco>", COMPILED))


COMPILED = "<mujoco><compiler autolimits='true'/>"


def test_equality_constraints_and_limits_of_joints_hold_where_nothing_is_said_of_them():
    given = coupled()
    found = with_holding_constraints(given, "equalities")
    assert found is not None
    np.testing.assert_allclose(found.model.eq_solref, [[0.004, 1.0]])
    np.testing.assert_allclose(found.model.eq_solimp[:, :2], STIFF_IMPEDANCE)
    np.testing.assert_array_equal(found.model.jnt_solref, given.model.jnt_solref)
    assert with_holding_constraints(found, "equalities") is None
    found = with_holding_constraints(given, "limits")
    assert found is not None
    np.testing.assert_allclose(found.model.jnt_solref, [[0.004, 1.0]] * 2)
    np.testing.assert_array_equal(found.model.eq_solref, given.model.eq_solref)
    np.testing.assert_array_equal(found.model.dof_solref, given.model.dof_solref)
    assert with_holding_constraints(found, "limits") is None


def test_constants_of_equality_constraints_and_limits_that_the_mjcf_sets_stay():
    own = " solref='.05 1' solimp='.8 .9 .001'"
    assert with_holding_constraints(coupled(own), "equalities") is None
    assert with_holding_constraints(coupled(default=f"<default><equality {own}/></default>"), "equalities") is None
    limit = " solreflimit='.05 1' solimplimit='.8 .9 .001'"
    assert with_holding_constraints(coupled(joint=limit), "limits") is None


def test_scenes_without_equality_constraints_or_limits_have_nothing_to_hold():
    assert with_holding_constraints(scene(), "equalities") is None
    assert with_holding_constraints(scene(), "limits") is None
