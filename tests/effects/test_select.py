"""Selections of model elements, effects in model files, and what the base class of effects checks."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np
import pytest
from small_worlds import BLOCK, GRIPPER, MOTOR, PENDULUM, SLIDER, world

from concent_warp.effects import catalogue, select
from concent_warp.effects.effect import AddedEffect, Effect, Parameter, prepare, variant_fields, write
from concent_warp.effects.force_model import ForceModel
from concent_warp.effects.library.contact import PadFriction, SlidingFriction
from concent_warp.effects.library.friction_forces import LoadFriction, StribeckFriction
from concent_warp.effects.library.joints import JointDamping, JointFriction
from concent_warp.effects.library.measurement import Latency
from concent_warp.effects.library.objects import Inertia, Mass
from concent_warp.effects.library.world import GravityTilt
from concent_warp.effects.registry import OURS, effect_class, effect_classes
from concent_warp.effects.table import checked_values, effects_table, read_effects
from concent_warp.effects.unknown_force import UnknownForce
from concent_warp.errors import EngineError, ModelError

ROBOT = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="1 1 .1"/>
  <geom name="painted" size=".1" pos="0 0 -1" contype="0" conaffinity="0"/>
  <body name="table"><geom name="table" size=".1" conaffinity="0"/></body>
  <body name="base"><joint name="turn" axis="0 0 1"/><geom size=".05" mass="2"/>
    <body name="bracket" pos="0 0 .1"><geom name="bracket" size=".02" mass=".1" contype="0" conaffinity="0"/>
      <body name="arm" pos="0 0 .1"><joint name="reach" type="slide"/><geom name="arm" size=".03" mass="1"/>
        <body name="left" pos=".05 0 .2"><joint name="left" type="slide" axis="1 0 0"/><geom size=".01"/></body>
        <body name="right" pos="-.05 0 .2"><joint name="right" type="slide" axis="-1 0 0"/><geom size=".01"/></body>
        <body name="third" pos="0 .1 .2"><joint name="t1" type="slide"/><joint name="t2" type="slide" axis="1 0 0"/>
          <geom size=".01"/></body>
      </body></body></body>
  <body name="ball" pos="1 0 0"><freejoint/><geom name="ball" size=".1" mass=".5"/></body>
  <body name="cardan" pos="2 0 0"><joint type="ball"/><geom size=".1"/></body>
  <body name="ground slide" pos="3 0 0"><joint name="g" type="slide"/><geom size=".1"/></body>
  <body name="ground slide too" pos="4 0 0"><joint name="h" type="slide"/><geom size=".1"/></body>
  <body pos="5 0 0"><freejoint/><geom size=".1"/></body>
</worldbody>
<tendon><fixed name="both"><joint joint="left" coef="1"/><joint joint="right" coef="1"/></fixed>
  <spatial name="rope"><site site="s1"/><site site="s2"/></spatial></tendon>
<actuator>
  <position name="turn" joint="turn" kp="20" kv="3"/>
  <general name="grip" tendon="both" gainprm="5" biastype="affine" biasprm="0 -5 0"/>
  <motor name="reach" jointinparent="reach"/>
  <general name="weak" joint="t1" gainprm="5" biastype="affine" biasprm="0 -4.9999 0"/>
  <general name="exact" joint="t1" gainprm="5" biastype="affine" biasprm="0 -4.999997 0"/>
  <general name="open" joint="t1" gainprm="5" biastype="none" biasprm="0 -5 0"/>
  <general name="backward" joint="t1" gainprm="-5" biastype="affine" biasprm="0 5 0"/>
  <general name="none" joint="t1" gainprm="0" biastype="affine" biasprm="0 0 0"/>
  <motor name="rope" tendon="rope"/>
  <motor joint="t2"/></actuator>
<sensor><jointpos name="q" joint="turn"/><jointvel name="qd" joint="turn"/><jointpos joint="reach"/>
  <framepos name="p" objtype="body" objname="ball"/><framequat name="o" objtype="body" objname="ball"/>
  <gyro name="rate" site="s1"/></sensor></mujoco>""".replace(
    '<body name="table">', '<site name="s1"/><site name="s2" pos="0 0 1"/><body name="table">'
)


@pytest.fixture(scope="module")
def m() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ROBOT)


def bodies(m: mujoco.MjModel, ids: list[int]) -> list[str]:
    """Return the names of bodies."""
    return [m.body(b).name for b in ids]


def test_joints_are_grouped_as_hinges_and_slides(m):
    assert select.joints_by_type(m) == (("turn",), ("reach", "left", "right", "t1", "t2", "g", "h"))
    assert select.joints_by_type(m, [2, 1]) == (("reach", "left"),)
    assert select.joints_by_type(m, [0]) == (("turn",),)
    assert select.joints_by_type(m, []) == ()


def test_joints_of_an_actuator_are_those_that_it_moves(m):
    driven = {a: [m.joint(j).name for j in select.driven_joints(m, a)] for a in range(m.nu)}
    assert driven[0] == ["turn"]
    assert driven[1] == ["left", "right"]
    assert driven[2] == ["reach"]
    assert driven[m.actuator("rope").id] == []
    assert driven[m.nu - 1] == ["t2"]


def test_bodies_are_selected_by_what_carries_them(m):
    assert bodies(m, select.free_bodies(m)) == ["ball", ""]
    assert select.unguided_body_targets(m) == (("ball",),)
    assert bodies(m, select.fingers(m)) == ["left", "right"]
    assert bodies(m, select.robot_bodies(m)) == ["base", "bracket", "arm", "left", "right", "third"]
    assert bodies(m, select.outermost_links(m)) == ["third", "cardan", "ground slide", "ground slide too"]
    gripper = mujoco.MjModel.from_xml_string(GRIPPER)
    assert bodies(gripper, select.outermost_links(gripper)) == ["hand"]


def test_actuators_are_the_grippers_or_the_arms(m):
    assert [m.actuator(a).name for a in select.gripper_actuators(m)] == ["grip"]
    assert select.arm_actuators(m) == ("turn", "reach", "weak", "exact", "open", "backward", "none")


def test_gain_of_a_servo_is_that_of_an_actuator_whose_bias_is_its_opposite(m):
    gains = {m.actuator(a).name: select.servo_gain(m, a) for a in range(m.nu)}
    expected = {"turn": 20.0, "grip": 5.0, "exact": 5.0}
    assert gains == {name: expected.get(name, 0.0) for name in gains}


def test_geoms_are_those_that_move_as_one_with_a_body_or_stand_still(m):
    def names(ids):
        return [m.geom(i).name for i in ids]

    assert names(select.geoms_of(m, m.body("base").id)) == ["", "bracket"]
    assert names(select.geoms_of(m, m.body("bracket").id)) == ["", "bracket"]
    assert names(select.static_geoms(m)) == ["floor", "painted", "table"]
    assert names(select.surfaces(m, m.body("ball").id)) == ["floor", "table", "ball"]


def test_sensors_are_selected_by_type_where_they_have_a_name(m):
    assert select.sensors_by_type(m, select.JOINTS) == ("q", "qd")
    assert select.sensors_by_type(m, select.JOINTS[:1]) == ("q",)
    assert select.sensors_by_type(m, select.POSES) == ("p", "o")
    assert select.sensors_by_type(m, select.POSES[:1]) == ("p",)


def test_a_typical_torque_accelerates_by_ten(m):
    joints = np.array([0, 2])
    np.testing.assert_array_equal(select.dof_of(m, joints), [0, 2])
    np.testing.assert_allclose(select.typical_torque(m, joints), 10 * m.dof_M0[[0, 2]])


def test_values_are_given_by_name_or_in_order_and_others_are_null():
    m = world(PENDULUM).compile()
    tilt = GravityTilt()
    assert checked_values(tilt, m, None) == (0.0, 0.0)
    assert checked_values(tilt, m, {"y": 0.1}) == (0.0, 0.1)
    assert checked_values(tilt, m, [0.5, -0.5]) == (0.5, -0.5)
    infinite = effect_class("actuator_saturation")("drive")
    assert checked_values(infinite, m, [np.inf]) == (np.inf,)
    for values, words in (
        ({"z": 1.0, "a": 2.0}, r"gravity_tilt has no such parameter.*\['x', 'y'\].*\['a', 'z'\]"),
        ([0.1], r"wrong number of values for gravity_tilt.*\['x', 'y'\].*1"),
        ([0.1, 0.2, 0.3], "wrong number of values"),
        ([0.0, 0.51], "gravity_tilt: y is out of bounds.*-0.5 to 0.5 rad.*0.51"),
        ([-0.51, 0.0], "gravity_tilt: x is out of bounds"),
    ):
        with pytest.raises(ModelError, match=words):
            checked_values(tilt, m, values)


def test_effects_are_written_as_tables_and_read_again():
    added = [
        AddedEffect(GravityTilt(), (0.1, -0.2)),
        AddedEffect(JointDamping("hinge"), (0.3,), ((0.2, 0.4),)),
    ]
    rows = effects_table(added)
    assert rows == [
        {"name": "gravity_tilt", "target": [], "values": [0.1, -0.2]},
        {"name": "joint_damping", "target": ["hinge"], "values": [0.3], "intervals": [[0.2, 0.4]]},
    ]
    again = read_effects(rows, Path("model.toml"))
    assert [type(a.effect) for a in again] == [GravityTilt, JointDamping]
    assert [(a.effect.target, a.values, a.intervals) for a in again] == [
        ((), (0.1, -0.2), ()),
        (("hinge",), (0.3,), ((0.2, 0.4),)),
    ]
    assert again[0].array.tolist() == [0.1, -0.2]
    assert read_effects([], Path("model.toml")) == []


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ({"name": "mass"}, "effects are not tables"),
        (["mass"], "effects are not tables"),
        ([{"name": "mass", "target": ["a"], "size": 1, "colour": 2}], r"unknown entries.*\['colour', 'size'\]"),
        ([{"target": ["a"]}], "the effect has no name"),
        ([{"name": 3}], "the effect has no name.*3"),
        ([{"name": "mass", "target": "a"}], "target is not right"),
        ([{"name": "mass", "target": ["a", 1]}], "target is not right"),
        ([{"name": "mass", "target": ["a"], "values": 1.0}], "values and intervals are not right"),
        ([{"name": "mass", "target": ["a"], "values": [True]}], "values and intervals are not right"),
        ([{"name": "mass", "target": ["a"], "values": ["1"]}], "values and intervals are not right"),
        ([{"name": "mass", "target": ["a"], "values": [float("nan")]}], "values and intervals are not right"),
        ([{"name": "mass", "target": ["a"], "values": [1], "intervals": 1}], "values and intervals are not right"),
        ([{"name": "mass", "target": ["a"], "values": [1], "intervals": [[1]]}], "values and intervals are not right"),
        ([{"name": "mass", "target": ["a"], "values": [1], "intervals": [["1", 2]]}], "not right"),
        ([{"name": "mass", "target": ["a"], "values": [1], "intervals": [1, 2]}], "not right"),
        ([{"name": "mas", "target": ["a"], "values": [1]}], "did you mean 'mass'"),
    ],
)
def test_effects_that_cannot_be_read_are_named_with_their_place(rows, words):
    with pytest.raises(ModelError, match=words) as raised:
        read_effects(rows, Path("model.toml"))
    assert "model.toml" in str(raised.value) or "did you mean" in words
    if isinstance(rows, list) and isinstance(rows[0], dict) and "did you mean" not in words:
        good = {"name": "gravity_tilt", "values": [0.0, 0.0]}
        with pytest.raises(ModelError, match=r"model\.toml: effect 1"):
            read_effects([good, *rows], Path("model.toml"))


def test_an_effect_is_found_by_its_name_and_others_are_suggested():
    assert effect_class("mass") is Mass
    assert list(effect_classes())[: len(OURS)] == [effect.name for effect in OURS]
    with pytest.raises(ModelError, match=r"no effect 'joint_frictoin'.*did you mean 'joint_friction'"):
        effect_class("joint_frictoin")
    with pytest.raises(ModelError, match=r"did you mean .*'joint_friction' or .*'sliding_friction'"):
        effect_class("friction")
    with pytest.raises(ModelError, match=r"no effect 'zzz'.*one of joint_friction, joint_damping"):
        effect_class("zzz")


def test_an_effect_shows_its_constructor_and_what_it_changes():
    assert repr(JointFriction("a", "b")) == "JointFriction('a', 'b')"
    assert repr(GravityTilt()) == "GravityTilt()"
    names = {"edits": {"size", "contact_geometry"}, "commands": {"actuator_delay", "actuator_lag"}}
    names["measures"] = {
        "joint_compliance", "time_base", "latency", "length_scale", "frame_offset", "sensor_bias", "sensor_gain",
    }  # fmt: skip
    for attribute, expected in names.items():
        assert {e.name for e in OURS if getattr(e("x"), attribute)} == expected


def test_an_effect_leaves_what_it_does_not_change():
    m = world(PENDULUM).compile()
    plain, values, ctrl = JointDamping("hinge"), np.array([0.3]), np.ones((3, 1))
    assert plain.command(m, ctrl, values) is ctrl
    assert plain.delay_and_lag(m, values) is None
    assert plain.force_model(m) is None
    assert plain.applies_to(m, 0)

    def read(_sensor, _time):
        return np.zeros((1, 1))

    assert plain.measure(m, read, values) is read
    assert Latency("encoder").fields(m) == ()
    assert Effect().fields(m) == ()
    assert Effect().applies_to(m, 0)
    for unknown in (Effect.targets, Effect().parameters):
        with pytest.raises(NotImplementedError):
            unknown(m)


BARE = '<body name="bare"><joint/><geom size=".1" contype="0" conaffinity="0"/></body>'


@pytest.mark.parametrize(
    ("effect", "words"),
    [
        (GravityTilt("thing"), r"gravity_tilt acts on the whole world.*no target.*\['thing'\]"),
        (Mass("thing", "stone", "tree"), r"mass has an unknown target.*bodies among.*\['stone', 'tree'\]"),
        (Mass(), r"mass has no target.*bodies among \['world', 'thing', 'bare'\].*none"),
        (SlidingFriction("thing", "bare"), r"cannot act on these targets.*geoms that collide.*\['bare'\]"),
        (JointDamping("slide"), "joint_damping has an unknown target"),
        (
            Inertia("stone", "axis_q"),
            r"inertia has an unknown target.*after them axis_x, axis_y.*\['stone', 'axis_q'\]",
        ),
        (Latency("position", "force"), r"latency has an unknown target.*\['position', 'orientation'\].*\['force'\]"),
    ],
)
def test_targets_are_checked(effect, words):
    m = world(BLOCK.replace("</worldbody>", f"{BARE}</worldbody>")).compile()
    with pytest.raises(ModelError, match=words):
        effect.check(m)


def test_targets_that_fit_pass_the_check():
    m = world(BLOCK).compile()
    for effect in (GravityTilt(), Mass("thing"), SlidingFriction("thing"), Latency("position")):
        effect.check(m)
    np.testing.assert_array_equal(Latency("orientation", "position").ids(m), [1, 0])
    still = mujoco.MjModel.from_xml_string('<mujoco><option gravity="0 0 0"/></mujoco>')
    assert GravityTilt.targets(still) == ()
    assert GravityTilt.targets(m) == ((),)


def test_parameters_are_one_a_target():
    effect = JointDamping("a", "b")
    one = effect.parameter_per_target("x", "N", 2.0, low=0.0, high=9.0, scale=0.5)
    assert one == tuple(Parameter(f"x[{t}]", "N", 2.0, 0.0, 9.0, 0.5) for t in "ab")
    two = effect.parameter_per_target("x", "N", [1.0, 3.0], low=0.0, high=9.0, scale=0.5)
    assert [p.null for p in two] == [1.0, 3.0]
    with pytest.raises(ValueError, match="broadcast"):
        effect.parameter_per_target("x", "N", [1.0, 2.0, 3.0], low=0.0, high=9.0, scale=0.5)


def test_fields_of_variants_are_those_that_each_row_of_values_gives():
    m = world(SLIDER.format(joint='damping="3"', actuator=MOTOR)).compile()
    effects = [JointDamping("rail"), GravityTilt(), Mass("cart")]
    values = np.array([[1.0, 0.1, 0.0, 2.0], [4.0, 0.0, -0.2, 0.5]])
    m.opt.gravity = [0, 0, -10]
    found = variant_fields(m, effects, values, [slice(0, 1), slice(1, 3), slice(3, 4)])
    assert list(found) == ["body_inertia", "body_mass", "dof_damping", "opt.gravity"]
    np.testing.assert_allclose(found["dof_damping"], [[1.0], [4.0]])
    np.testing.assert_allclose(found["body_mass"], [[0, 4.0], [0, 1.0]])
    np.testing.assert_allclose(found["body_inertia"][:, 1], np.outer([2.0, 0.5], m.body_inertia[1]))
    np.testing.assert_allclose(
        found["opt.gravity"],
        [[0, 10 * np.sin(0.1), -10 * np.cos(0.1)], [-10 * np.sin(-0.2), 0, -10 * np.cos(0.2)]],
        atol=1e-12,
    )
    assert m.dof_damping[0] == 3.0


def test_effects_prepare_an_mjcf_all_before_any_edits_it_and_write_in_their_order():
    done = []

    class Noted(JointDamping):
        def prepare(self, spec):
            del spec
            done.append(("prepare", self.target[0]))

        def edit(self, spec, values):
            del spec
            done.append(("edit", self.target[0], values.tolist()))

        def write(self, m, values):
            del m
            done.append(("write", self.target[0], values.tolist()))

    added = [AddedEffect(Noted("a"), (1.0,)), AddedEffect(Noted("b"), (2.0,))]
    prepare(mujoco.MjSpec(), added)
    write(world(BLOCK).compile(), added)
    assert done == [
        ("prepare", "a"), ("prepare", "b"), ("edit", "a", [1.0]), ("edit", "b", [2.0]),
        ("write", "a", [1.0]), ("write", "b", [2.0]),
    ]  # fmt: skip


def test_force_models_are_equal_where_they_are_of_one_class_and_act_on_the_same():
    one, same, other = (StribeckFriction(np.array(dofs)) for dofs in ([0, 1], [0, 1], [1, 0]))
    assert one == same
    assert hash(one) == hash(same)
    assert one != other
    assert one != LoadFriction(np.array([0, 1]))
    assert one != 3
    assert len({one, same, other}) == 2


def test_a_force_model_without_a_kernel_says_so():
    class Wind(ForceModel):
        def apply(self, m, d, values):
            del m
            d.qfrc_applied[:] = values

    with pytest.raises(EngineError, match=r"Wind cannot run on MuJoCo-Warp.*use the mujoco engine"):
        Wind().launch(*cast("tuple[Any, Any, Any]", (None, None, None)))
    m = world(PENDULUM).compile()
    d = mujoco.MjData(m)
    act = Wind().bound(m, d, np.array([2.0]))
    assert d.qfrc_applied[0] == 0
    act()
    assert d.qfrc_applied[0] == 2
    with pytest.raises(NotImplementedError):
        ForceModel().apply(m, d, np.zeros(1))


def test_rows_of_the_catalogue_name_engines_units_and_confusions():
    m = world(GRIPPER).compile()
    assert catalogue._unit(["-"]) == ""
    assert catalogue._unit(["N"]) == " N"
    assert catalogue._unit(["N m", "N"]) == " N m or N"
    assert catalogue._parameters(JointDamping, m) == "`damping[joint]` N s/m"
    assert catalogue._parameters(PadFriction, m) == "`coefficient`"

    class OneEngine(PadFriction):
        name, engines = "one_engine", ("mujoco",)
        summary, confusions = "A | B.", ("grip_force", "wet_hands")

    cells = catalogue._row(OneEngine, m).split(" | ")
    assert cells[0] == "| `one_engine` on bodies"
    assert cells[1] == "A \\| B. Engine: mujoco."
    assert cells[2] == "`coefficient`"
    assert cells[3] == PadFriction.signature
    assert cells[4] == "`grip_force`, wet hands"
    assert cells[5].startswith("Coulomb friction")
    assert " Engine: " not in catalogue._row(PadFriction, m)


def test_the_catalogue_has_a_table_for_each_family():
    text = catalogue._catalogue()
    assert [line for line in text.splitlines() if line.startswith("###")] == [
        f"### {title}" for title in catalogue.TITLES.values()
    ]
    assert text.count("\n| `") == len(OURS)
    assert text.endswith("|\n")


def test_an_unknown_force_has_a_size_for_each_of_its_bumps():
    class Three:
        count = 3

    force = UnknownForce("a force", Three())  # pyright: ignore[reportArgumentType]
    rows = force.parameters(world(PENDULUM).compile())
    assert rows == tuple(Parameter(f"size[{k}]", "-", 0.0, -100.0, 100.0, 1.0) for k in range(3))
    assert force.engines == ("mujoco",)
    assert force.words == "a force"
    assert force.target == ()
