"""What a task reads off a model, its events and a replay, on small models worked out by hand."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from made_up_task import SETTINGS, make_events, make_model, make_task

from concent_warp.errors import TrainError
from concent_warp.events.sequence import ContactEvent, ContactInterval, ContactPair, Entity
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene
from concent_warp.train.cfg import ALL, LAST, ActionCfg, TrainCfg
from concent_warp.train.task.movable_fixtures import mocap_id, with_movable_fixtures
from concent_warp.train.task.robot import Robot, _opening
from concent_warp.train.task.task import Replay, Task, _chain, _objects_by_handling, _replay, _target_position
from concent_warp.train.train import _warn_of_push

ARM = """
<mujoco>
  <worldbody>
    <body name="loose"><freejoint/><geom size="0.1" mass="1"/></body>
    <body name="arm">
      <joint name="turn" type="hinge"/><geom size="0.1" mass="1"/>
      <site name="other"/><site name="tcp"/>
      <body name="slider">
        <joint name="slide" type="slide"/><geom size="0.1" mass="1"/>
        <body><joint name="a" type="slide"/><geom size="0.1" mass="1"/></body>
        <body><joint name="b" type="slide"/><geom size="0.1" mass="1"/></body>
        <body><joint name="ball" type="ball"/><geom size="0.1" mass="1"/></body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="fingers"><joint joint="a" coef="0.5"/><joint joint="b" coef="-0.25"/></fixed>
    <spatial name="rope"><site site="other"/><site site="tcp"/></spatial>
  </tendon>
  <actuator>{actuators}</actuator>
</mujoco>
"""
PLAIN = '<position name="slide" joint="slide"/><position name="turn" joint="turn"/>'


def arm(actuators: str = PLAIN) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM.format(actuators=actuators))


def test_addresses_are_those_of_the_joints_in_the_order_of_the_actuators():
    m = arm(f'<position name="gripper" joint="a"/>{PLAIN}')
    cfg = ActionCfg(turn=0.1, slide=0.2, gripper=0.3, turn_lead=0.4, slide_lead=0.5)
    found = Robot.of(m, cfg)
    assert found.joint.tolist() == [2, 1]
    assert found.qpos.tolist() == [8, 7]
    assert found.dof.tolist() == [7, 6]
    assert found.turning.tolist() == [False, True]
    assert found.actuator.tolist() == [1, 2]
    assert found.gripper.tolist() == [0]
    assert found.step.tolist() == [0.2, 0.1, 0.3]
    assert found.lead.tolist() == [0.5, 0.4]
    assert found.tool == m.site("tcp").id == 1
    assert found.actions == 3
    assert found.opening.tolist() == [0.0] * 9 + [1.0] + [0.0] * 5
    without = Robot.of(arm(), cfg)
    assert without.gripper.tolist() == []
    assert without.gripper.dtype == without.actuator.dtype == int
    assert without.step.tolist() == [0.2, 0.1]
    assert not without.opening.any()
    assert Robot.of(arm(), replace(cfg, tool_site="other")).tool == 0


def test_opening_is_the_mean_length_of_the_grippers_actuators():
    m = arm(
        '<position name="one" joint="a"/><position name="two" joint="b"/><position name="both" tendon="fingers"/>'
        '<position name="rope" tendon="rope"/>'
    )
    a, b = (int(m.joint(name).qposadr[0]) for name in "ab")

    def weights(*gripper: int) -> tuple[float, float]:
        found = _opening(m, list(gripper))
        assert found.shape == (m.nq,)
        assert np.abs(found).sum() == pytest.approx(abs(found[a]) + abs(found[b]))
        return float(found[a]), float(found[b])

    assert weights(0) == (1.0, 0.0)
    assert weights(0, 1) == (0.5, 0.5)
    assert weights(2) == (0.5, -0.25)
    assert weights(2, 1) == (0.25, 0.375)
    assert weights(3) == (0.0, 0.0)
    assert weights() == (0.0, 0.0)


@pytest.mark.parametrize("drives", ['joint="ball"', 'tendon="fingers"', 'body="slider" cranklength="1"'])
def test_actuators_of_the_arm_drive_single_joints(drives):
    other = (
        f"<general name='wrong' {drives}/>"
        if "body" not in drives
        else "<adhesion name='wrong' body='slider' ctrlrange='0 1'/>"
    )
    with pytest.raises(TrainError, match=r"'wrong' drives no hinge or slide joint.*gripper-actuators"):
        Robot.of(arm(PLAIN + other), ActionCfg())


OTHER_COMMANDS = {
    "motor": '<motor name="turn" joint="turn" ctrlrange="-1 1"/>',
    "velocity": '<velocity name="turn" joint="turn" kv="3"/>',
    "intvelocity": '<intvelocity name="turn" joint="turn" kp="3" actrange="-1 1"/>',
    "damper": '<damper name="turn" joint="turn" kv="3" ctrlrange="0 1"/>',
}


@pytest.mark.parametrize("drives", OTHER_COMMANDS.values(), ids=OTHER_COMMANDS)
def test_commands_that_are_no_positions_are_refused_with_what_to_do(drives):
    with pytest.raises(TrainError, match=r"command of actuator 'turn' is no position.*<position> actuators.*own_robot"):
        Robot.of(arm(drives), ActionCfg())


def test_servos_are_taken_in_every_notation_but_not_with_a_gear():
    for drives in (
        '<general name="turn" joint="turn" gainprm="20" biastype="affine" biasprm="0 -20 -1"/>',
        '<position name="turn" jointinparent="turn" kp="20" timeconst="0.1"/>',
        '<position name="turn" joint="turn" kp="20" dampratio="1"/>',
    ):
        assert Robot.of(arm(drives), ActionCfg()).actions == 1
    with pytest.raises(TrainError, match=r"'turn' has a gear; expected 1, found 50.*square of the gear"):
        Robot.of(arm('<position name="turn" joint="turn" kp="20" gear="50"/>'), ActionCfg())


def test_grippers_that_are_no_lengths_step_by_a_share_of_their_range():
    cup = '<adhesion name="cup" body="slider" gain="20" ctrlrange="0 2"/>'
    cfg = ActionCfg(gripper_actuators=("cup",), gripper_share=0.25)
    found = Robot.of(arm(PLAIN + cup), cfg)
    assert found.step[-1] == 0.5
    assert not found.in_metres
    assert not found.opening.any()
    bytes_of = '<general name="cup" tendon="fingers" ctrlrange="0 255" gainprm="0.3" biastype="affine" biasprm="0 -9"/>'
    assert Robot.of(arm(PLAIN + bytes_of), cfg).step[-1] == 0.25 * 255
    turning = '<position name="cup" joint="turn" ctrlrange="0 1"/>'
    assert Robot.of(arm(turning), cfg).step.tolist() == [0.25]
    with pytest.raises(TrainError, match=r"'cup' has no range of commands.*ctrlrange"):
        Robot.of(arm(turning.replace('ctrlrange="0 1"', "")), cfg)
    both = replace(cfg, gripper_actuators=("cup", "finger"))
    with pytest.raises(TrainError, match=r"one number cannot command all.*'cup': 0.5, 'finger': 0.003"):
        Robot.of(arm(PLAIN + cup + '<position name="finger" joint="a"/>'), both)


def test_turning_fingers_whose_range_is_in_degrees_are_refused():
    cfg = ActionCfg(gripper_actuators=("turn",))
    limited = arm('<position name="turn" joint="turn" ctrlrange="-40 40"/>')
    limited.jnt_limited[1], limited.jnt_range[1] = 1, (-0.7, 0.7)
    with pytest.raises(TrainError, match=r"'turn' is far beyond its joint.*-0.7 to 0.7, found -40 to 40; write rad"):
        Robot.of(limited, cfg)
    limited.actuator_gear[0, 0] = -57.3  # commands in degrees
    assert Robot.of(limited, cfg).step[-1] == pytest.approx(80 * cfg.gripper_share)
    limited.actuator_gear[0, 0] = 1
    limited.actuator_ctrlrange[0] = -1.5, 1.5  # closes with force
    assert Robot.of(limited, cfg).step[-1] == pytest.approx(3 * cfg.gripper_share)


@pytest.mark.parametrize(("bodies", "name", "warned"), [
    (("robot", "block"), "contact robot-block", True),
    (("robot", "block"), "pick", False),
    (("block", "box"), "contact block-box", False),
])  # fmt: skip
def test_a_task_that_ends_with_a_push_is_warned_of(bodies, name, warned, recwarn):
    first, *_ = make_events().stages
    stages = (replace(first, bodies=bodies, name=name),)
    run = SimpleNamespace(events=replace(make_events(), stages=stages), cfg=TrainCfg())
    _warn_of_push(run)  # type: ignore[arg-type]
    assert [str(w.message)[:70] for w in recwarn] == [
        "stage 'contact robot-block' counts as done when the robot touches 'blo"
    ] * warned


def test_a_gripper_that_is_named_must_be_there():
    with pytest.raises(TrainError, match=r"no actuator 'jaws'; found \['slide', 'turn'\].*gripper-actuators"):
        Robot.of(arm(), ActionCfg(gripper_actuators=("slide", "jaws")))


def test_a_missing_tool_site_is_an_error_that_names_those_there_are():
    with pytest.raises(TrainError, match=r"no tool site.*nose.*\['other', 'tcp'\].*--environment.action.tool-site"):
        Robot.of(arm(), ActionCfg(tool_site="nose"))
    none = "<mujoco><worldbody><body><joint name='a'/><geom size='1'/></body></worldbody></mujoco>"
    with pytest.raises(TrainError, match=r"no tool site.*found \[\].*after adding it to the scene"):
        Robot.of(mujoco.MjModel.from_xml_string(none), ActionCfg())


FIXTURES = """
<mujoco>
  <custom><text name="concent_objects" data="box lid block"/></custom>
  <worldbody>
    <body name="stand"><geom size="0.1"/></body>
    <body name="box" pos="1 0 0"><geom size="0.1"/><body name="label"><geom size="0.1"/></body></body>
    <body name="lid" pos="2 0 0"><geom size="0.1"/></body>
    <body name="block" pos="3 0 0"><freejoint/><geom size="0.1"/></body>
    <body><geom size="0.1"/></body>
  </worldbody>
  <contact><exclude body1="lid" body2="stand"/></contact>
</mujoco>
"""


def test_fixed_objects_become_mocap_bodies_that_touch_nothing_fixed():
    scene = Scene(FIXTURES, "here")
    found = with_movable_fixtures(scene)
    m = found.model
    assert found.source == "here"
    assert [m.body(i).name for i in range(m.nbody) if m.body_mocapid[i] >= 0] == ["box", "lid"]
    assert mocap_id(m, m.body("box").id) == 0
    assert mocap_id(m, m.body("lid").id) == 1
    for other in ("stand", "block", "label"):
        assert mocap_id(m, m.body(other).id) is None
    excluded = sorted(tuple(sorted((e.bodyname1, e.bodyname2))) for e in found.spec().excludes)
    # "body6" has no name in the scene.
    fixed = [("box", "label"), ("box", "lid"), ("box", "stand"), ("label", "lid"), ("lid", "stand")]
    assert [p for p in excluded if "world" not in p] == [("body6", "box"), ("body6", "lid"), *fixed]
    assert len(excluded) == len(set(excluded)) == 9
    assert with_movable_fixtures(found) == found
    loose = Scene("<mujoco><worldbody><body name='a'><freejoint/><geom size='0.1'/></body></worldbody></mujoco>")
    assert with_movable_fixtures(loose) is loose


def test_chain_is_of_all_stages_or_of_one():
    events = make_events()
    assert _chain(events, ALL) == (0, 2)
    assert _chain(events, LAST) == (2, 2)
    assert [_chain(events, name) for name in ("pick", "align", "insert")] == [(0, 0), (1, 1), (2, 2)]
    with pytest.raises(TrainError, match=r"no such stage.*\['pick', 'align', 'insert', 'last', 'all'\].*fly"):
        _chain(events, "fly")
    for name in (ALL, LAST, "pick"):
        with pytest.raises(TrainError, match=r"no stage to train.*begins during it.*from before the first contact"):
            _chain(replace(events, stages=()), name)
    assert make_task().chained == (0, 1, 2)
    assert make_task(first=1).chained == (1, 2)
    assert make_task(first=2).chained == (2,)


def test_objects_are_grasped_in_stages_that_do_not_start_with_the_robot():
    task = make_task()
    assert [task.starts_grasped(s) for s in range(3)] == [False, True, True]
    assert [task.grasped_objects(s) for s in range(3)] == [(False,) * 3, (True, False, False), (True, False, False)]
    none = replace(task, robot_slots=np.zeros_like(task.robot_slots))
    assert [none.starts_grasped(s) for s in range(3)] == [False] * 3
    assert none.grasped_objects(2) == (False,) * 3


def test_contacts_of_the_robot_that_only_the_target_has_are_no_grasp():
    task = make_task()
    table, rested = task.table, 1
    box = task.compiled.body("box").id
    body_a, body_b, robot = table.body_a.copy(), table.body_b.copy(), task.robot_slots.copy()
    body_a[2, rested], body_b[2, rested], robot[2, rested] = task.compiled.body("left").id, box, True
    touching = replace(task, table=replace(table, body_a=body_a, body_b=body_b), robot_slots=robot)
    assert touching.grasping_slots(2).tolist() == [False, False, True]
    assert touching.grasped_objects(2) == (True, False, False)
    # The box was touched, and no longer is, when the stage begins.
    (held,) = task.events.body_contacts
    events = replace(task.events, body_contacts=(held, replace(held, b="box", start=1.0, end=1.9)))
    assert replace(touching, events=events).grasping_slots(2).tolist() == [False, False, True]


def test_objects_are_in_the_order_of_the_time_for_which_links_touch_them():
    model = make_model()

    def touch(a: str, b: str, start: float, end: float) -> ContactInterval:
        return ContactInterval(a, b, start, end, 1.0, (0, 0, 0), (0, 0, 1))

    entities = (Entity("hand", "robot", "hand"), Entity("left", "robot", "left"), Entity("x", "object", "block", 0))

    def order(*contacts: ContactInterval) -> list[str]:
        return _objects_by_handling(model, replace(make_events(), entities=entities, body_contacts=contacts))

    assert order() == ["block", "box"]
    assert order(touch("hand", "box", 1.0, 2.0)) == ["box", "block"]
    twice = touch("hand", "block", 0.0, 0.75), touch("left", "block", 5.0, 5.5)
    assert order(touch("hand", "box", 1.0, 2.0), *twice) == ["block", "box"]
    assert order(touch("hand", "box", 1.0, 2.0), twice[0]) == ["box", "block"]
    # Contacts of objects with one another and with things that are none count for nothing.
    others = touch("block", "box", 0.0, 9.0), touch("hand", "table", 0.0, 9.0)
    assert order(*others, touch("hand", "box", 1.0, 1.25)) == ["box", "block"]
    assert order(touch("block", "box", 0.0, 9.0), twice[0]) == ["block", "box"]


def test_rows_are_those_of_the_nearest_step_within_the_replay():
    replay = Replay(0.25, np.zeros((5, 1)), np.zeros((5, 1)), np.zeros((4, 1)), 0, 0)
    times = {-1.0: 0, 0.0: 0, 0.1: 0, 0.2: 1, 0.3: 1, 0.5: 2, 0.75: 3, 1.0: 3, 9.0: 3}
    assert {time: replay.row(time) for time in times} == times


def test_target_position_is_that_of_object_1_in_object_2_when_the_event_happens():
    task = make_task(target=None)
    m, (block, box, peg) = task.compiled, task.objects
    turn = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    pairs = (ContactPair("block_sphere0", "box_sphere0", (0, 0, 0), (0, 0, 0), (0, 0, 1), 1.0),)
    entities = (*task.events.entities, Entity("box_sphere0", "object", "box", 2))
    stages = [replace(s, event=ContactEvent(0.5 * k, (), (), pairs)) for k, s in enumerate(task.events.stages)]
    events = replace(task.events, entities=entities, stages=tuple(stages))
    qpos = np.tile(m.qpos0, (151, 1))
    qpos[:, 0] = np.arange(151)
    replay = replace(task.replay, qpos=qpos)

    def target(stage: int, objects: tuple[int, ...]) -> np.ndarray:
        found = _target_position(m, replay, events, stage, objects)
        assert found is not None
        return found

    # At 1 s, step 50: 50 m from the origin, and the box stands at 0.3 m.
    np.testing.assert_allclose(target(2, task.objects), [49.7, 0.0, 0.3], atol=1e-9)
    np.testing.assert_allclose(target(1, (box, block)), [-24.7, 0.0, -0.3], atol=1e-9)
    qpos[:, 3:7] = turn
    np.testing.assert_allclose(target(1, (box, block)), [0.0, 24.7, -0.3], atol=1e-9)
    assert _target_position(m, replay, events, 2, (block, peg)) is None
    assert _target_position(m, replay, events, 2, (block,)) is None
    assert _target_position(m, replay, task.events, 2, (block, box)) is None


def test_replay_has_the_states_of_the_demonstration_and_the_most_contacts():
    model = make_model()
    m = model.compile(np.ones(3, bool))
    time = np.arange(0, 0.5, 0.02)
    qpos = m.qpos0.copy()
    qpos[:3] = [0.27, 0.03, 0.06]  # its first sphere above that of the box
    action = {name: Channel(time, np.zeros(len(time))) for name in ("grip_left", "lift", "grip_right", "turn")}
    demonstration = Demonstration("falls", action=action, qpos=qpos)
    found = _replay(m, model, demonstration, np.ones(3, bool))
    d = mujoco.MjData(m)
    d.qpos[:] = qpos
    contacts = constraints = 0
    for k in range(len(found.ctrl)):
        np.testing.assert_allclose(found.qpos[k], d.qpos, atol=1e-9)
        np.testing.assert_allclose(found.qvel[k], d.qvel, atol=1e-9)
        d.ctrl[:] = found.ctrl[k]
        mujoco.mj_step(m, d)
    assert found.qpos.shape == (len(found.ctrl) + 1, m.nq)
    assert found.timestep == 0.02
    for k in range(0, len(found.ctrl), 4):
        d.qpos[:], d.qvel[:] = found.qpos[k], found.qvel[k]
        mujoco.mj_forward(m, d)
        contacts, constraints = max(contacts, d.ncon), max(constraints, d.nefc)
    assert (found.contacts, found.constraints) == (contacts, constraints)
    assert contacts > 0
    with pytest.raises(TrainError, match=r"falls.*diverges"):
        _replay(m, model, replace(demonstration, qvel=np.full(m.nv, 1e9)), np.ones(3, bool))


def test_a_task_needs_contact_geometry():
    demonstration = SimpleNamespace()
    with pytest.raises(TrainError, match=r"no contact geometry.*concent fit"):
        Task.build(make_model().with_geometry(None), demonstration, SETTINGS)  # pyright: ignore[reportArgumentType]
