from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from concent_warp.comparison.phases import Phase, has_task, phases_by_body, stage_phases
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.replay import commands, replay

FLOOR = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 .1" friction="{friction}"/>
    <body name="thing" pos="0 0 {height}"><freejoint/>
      <geom type="{shape}" size=".03 .03 .03" mass=".1" friction="{friction}"/></body>
  </worldbody>
</mujoco>
"""


def phases(xml, duration, qvel=None, command=None, qpos=None):
    model = Model(Scene(xml))
    m = model.compile()
    time = np.array([0, duration])
    action = {} if command is None else {m.actuator(0).name: Channel(*command)}
    demonstration = Demonstration(
        "demo_0",
        qpos=m.qpos0 if qpos is None else np.array(qpos),
        qvel=np.zeros(m.nv) if qvel is None else np.array(qvel),
        action=action,
        measured={"clock": Channel(time, np.zeros((2, 1)))},
    )
    engine = MujocoEngine(model)
    rollout = replay(model, demonstration, engine, contacts="all").numpy()
    return phases_by_body(model, engine.compiled, rollout)[None]


def names(found):
    return [p.name for p in found]


def thing(height=0.03, shape="box", friction=0.5):
    return FLOOR.format(height=height, shape=shape, friction=f"{friction} .005 .0001")


def test_a_dropped_box_falls_hits_and_rests():
    found = phases(thing(height=0.23), 1.0)
    assert names(found)[:2] == ["free", "impact"]
    assert names(found)[-1] == "rest"
    assert found[1].start == pytest.approx(np.sqrt(2 * 0.2 / 9.81), abs=0.02)
    assert (found[0].start, found[-1].end) == (-np.inf, np.inf)
    assert all(a.end == b.start for a, b in pairwise(found))


def test_a_launched_box_slides_until_friction_stops_it():
    found = phases(thing(friction=0.2), 1.0, qvel=[1, 0, 0, 0, 0, 0])
    assert names(found) == ["slide", "rest"]
    assert found[1].start == pytest.approx(1 / (0.2 * 9.81), abs=0.03)


def test_a_rolling_ball_sticks_to_what_it_rolls_on():
    found = phases(thing(shape="sphere"), 0.6, qvel=[0.3, 0, 0, 0, 10, 0])
    assert names(found) == ["stick"]


PENDULUM = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="rod" pos="0 0 1"><joint name="hinge" type="hinge" axis="0 1 0" damping="{damping}"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".01" mass=".2"/></body>
  </worldbody>
</mujoco>
"""


def test_a_pendulum_swings_free_without_resting_where_it_turns():
    assert names(phases(PENDULUM.format(damping=0), 3, qpos=[1.0])) == ["free"]


def test_a_wheel_without_shapes_that_spins_about_its_axis_does_not_rest():
    wheel = """<mujoco><worldbody><body><joint name="axle" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/></body></worldbody></mujoco>"""
    assert names(phases(wheel, 0.5, qvel=[3.0])) == ["free"]
    assert names(phases(wheel, 0.5)) == ["rest"]


def test_a_damped_pendulum_comes_to_rest():
    assert names(phases(PENDULUM.format(damping=0.12), 6, qpos=[0.5])) == ["free", "rest"]


GRIPPER = """
<mujoco>
  <option timestep="0.002"/>
  <custom><text name="concent_objects" data="block"/></custom>
  <worldbody>
    <geom name="table" type="plane" size="1 1 .1"/>
    <body name="left" pos="0 -.06 .03"><joint name="left" type="slide" axis="0 1 0"/>
      <geom type="box" size=".02 .01 .02" mass=".5"/></body>
    <body name="right" pos="0 .06 .03"><joint name="right" type="slide" axis="0 -1 0"/>
      <geom type="box" size=".02 .01 .02" mass=".5"/></body>
    <body name="block" pos="0 0 .03"><freejoint/><geom type="box" size=".03 .03 .03" mass=".1"/></body>
  </worldbody>
  <tendon><fixed name="grip"><joint joint="left" coef="1"/><joint joint="right" coef="1"/></fixed></tendon>
  <equality><joint joint1="left" joint2="right"/></equality>
  <actuator><position name="grip" tendon="grip" kp="200" kv="20"/></actuator>
</mujoco>
"""


def test_a_block_between_fingers_is_grasped():
    time = np.linspace(0, 1, 51)
    found = phases(GRIPPER, 1.0, command=(time, 0.08 * np.clip(2 * time, 0, 1)))
    assert names(found)[-2:] == ["rest", "grasped"]
    assert found[-1].start == pytest.approx(0.35, abs=0.1)


def test_a_replay_that_diverges_is_not_parted():
    wild = PENDULUM.format(damping=-100)
    assert names(phases(wild, 1, qpos=[0.5], qvel=[1])) == ["free"]


def test_stages_are_preceded_by_a_free_phase_and_have_no_end():
    found = stage_phases((Phase("push", 0.5, 1.0),), 1.0)
    assert found == (Phase("free", -np.inf, 0.5), Phase("push", 0.5, np.inf))
    assert stage_phases((), 1.0) == (Phase("free", -np.inf, np.inf),)


@dataclass(frozen=True)
class Stage(Phase):
    bodies: tuple[str, str] = ("robot", "block")


def test_stages_describe_a_task_where_a_robot_opens_one_of_several():
    pick, align = Stage("pick", 0.5, 1), Stage("align", 1, 2, ("block", "box"))
    assert has_task({"demo_0": (), "demo_1": (pick, align)})
    assert not has_task({"demo_0": (pick,)})
    assert not has_task({"demo_0": (align, align)})
    assert not has_task({})


def test_two_objects_have_separate_phases_and_the_faster_one_gives_those_of_the_demonstration():
    other = '<body name="other" pos="1 0 .03"><freejoint/><geom type="box" size=".03 .03 .03"/></body></worldbody>'
    model = Model(Scene(thing(height=0.23).replace("</worldbody>", other)))
    engine = MujocoEngine(model)
    clock = Channel(np.array([0, 0.5]), np.zeros((2, 1)))
    start = model.scene.model.qpos0
    demonstration = Demonstration("d", qpos=start, measured={"clock": clock})
    found = phases_by_body(model, engine.compiled, replay(model, demonstration, engine, contacts="all"))
    assert set(found) == {None, "thing", "other"}
    assert names(found["thing"])[:2] == names(found[None])[:2] == ["free", "impact"]
    assert names(found["other"])[-1] == "rest"


def test_what_a_suction_cup_holds_is_grasped():
    scene = Scene("""
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="cup" pos="0 0 0.5" gravcomp="1"><joint name="z" type="slide" axis="0 0 1"/>
      <geom type="box" size="0.02 0.02 0.01" mass="1"/></body>
    <body name="thing" pos="0 0 0.46"><freejoint/><geom type="box" size="0.03 0.03 0.03" mass="0.1"/></body>
  </worldbody>
  <actuator>
    <position name="z" joint="z" kp="1000" dampratio="1"/>
    <adhesion name="suction" body="cup" gain="20" ctrlrange="0 1"/>
  </actuator>
</mujoco>""")
    model = Model(scene)
    engine = MujocoEngine(model)
    time = np.linspace(0, 1, 50)
    action = {"z": Channel(time, 0.2 * time), "suction": Channel(time, np.ones(50))}
    demonstration = Demonstration("d", qpos=scene.model.qpos0, action=action)
    rollout = replay(model, demonstration, engine, contacts="all").numpy()
    ctrl = commands(engine.compiled, demonstration, len(rollout.step) - 1)
    found = phases_by_body(model, engine.compiled, rollout, ctrl=ctrl)["thing"]
    assert "grasped" in names(found)
    assert "grasped" not in names(phases_by_body(model, engine.compiled, rollout)["thing"])


TOOL = """
<mujoco>
  <option timestep="0.001"/>
  <worldbody>
    <geom type="plane" size="2 2 .1" friction=".1"/>
    <body name="carriage" pos="0 0 .2"><joint type="slide" axis="1 0 0"/><geom type="box" size=".05 .05 .02" mass="1"/>
      <body name="tool" pos="0 0 -.1"><joint name="down" type="slide" axis="0 0 1" stiffness="20" damping="20"/>
        <geom size=".02" pos="0 0 -.08" mass=".2" friction=".1"/></body></body>
    <body name="arm" pos="0 1 1"><joint axis="0 1 0" damping=".001"/><geom size=".02" pos="0 0 -.2" mass=".1"/></body>
  </worldbody>
</mujoco>
"""


def test_a_machine_is_in_contact_where_any_of_its_links_is_and_others_are_not():
    model = Model(Scene(TOOL))
    engine, m = MujocoEngine(model), model.compile()
    demonstration = Demonstration(
        "d", qpos=m.qpos0, qvel=np.array([0.5, 0, 3.0]), measured={"c": Channel(np.array([0, 1.0]), np.zeros((2, 1)))}
    )
    found = phases_by_body(model, engine.compiled, replay(model, demonstration, engine, contacts="all").numpy())
    assert set(found) == {None, "carriage", "tool", "arm"}
    assert found["carriage"] == found["tool"]  # one machine, although the tool alone touches the floor
    assert "slide" in names(found["carriage"])
    assert "free" not in names(p for p in found["carriage"] if p.start > 0.2)
    assert names(found["arm"]) == ["free"]
    # All together do what comes first of what any machine does.
    assert names(found[None])[0] == names(found["carriage"])[0]
