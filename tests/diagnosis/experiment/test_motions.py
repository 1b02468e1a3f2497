import numpy as np
import pytest

from concent_warp.diagnosis.experiment.cfg import MotionMenuCfg
from concent_warp.diagnosis.experiment.joint_motions import drive_motions
from concent_warp.diagnosis.experiment.motions import RecordedRange, slope_turned
from concent_warp.diagnosis.experiment.object_motions import ThrowableBody, _roll, body_motions
from concent_warp.diagnosis.experiment.payloads import on_object
from concent_warp.effects.library.world import AirDrag, GravityTilt
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

XML = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <geom name="table" type="plane" size="2 2 .1"/>
  <body name="hand" pos="-.2 0 .2"><joint name="reach" type="slide" axis="1 0 0"/>
    <geom type="box" size=".02 .05 .01" mass=".4" contype="0" conaffinity="0"/>
    <body name="left" pos="0 .05 -.1"><joint name="left" type="slide" axis="0 -1 0"/>
      <geom type="box" size=".01 .005 .03" mass=".05"/></body>
    <body name="right" pos="0 -.05 -.1"><joint name="right" type="slide" axis="0 1 0"/>
      <geom type="box" size=".01 .005 .03" mass=".05"/></body></body>
  <body name="block" pos=".1 0 .02"><freejoint/><geom {shape} mass=".3"/></body>
</worldbody>
<actuator><position name="reach" joint="reach" kp="500" kv="20"/><position name="left" joint="left" kp="100" kv="5"/>
  <position name="right" joint="right" kp="100" kv="5"/></actuator>
<sensor><jointpos name="reach_position" joint="reach"/>
  <framepos name="block_position" objtype="xbody" objname="block"/>
  <framequat name="block_orientation" objtype="xbody" objname="block"/></sensor></mujoco>"""
BOX = 'type="box" size=".03 .02 .02"'
TIME = np.arange(0, 2, 0.02)


def bench(shape: str = BOX, lift: float = 0.0) -> RecordedRange:
    """A hand that goes to and fro and closes, and an object that lies still."""
    model = Model(Scene(XML.format(shape=shape)))
    qpos = model.scene.model.qpos0.copy()
    qpos[5] += lift
    action = {
        "reach": Channel(TIME, 0.1 * np.sin(3 * TIME)),
        "left": Channel(TIME, 0.02 * (TIME > 1)),
        "right": Channel(TIME, 0.02 * (TIME > 1)),
    }
    still = np.tile(qpos[3:], (len(TIME), 1))
    measured = {
        "reach_position": Channel(TIME, action["reach"].value[:, None]),
        "block_position": Channel(TIME, still[:, :3]),
        "block_orientation": Channel(TIME, still[:, 3:]),
    }
    d = Demonstration("take", qpos=qpos, qvel=np.zeros(model.scene.model.nv), action=action, measured=measured)
    noise = {"reach_position": 1e-4, "block_position": 3e-4, "block_orientation": 3e-3}
    return RecordedRange(model, Recording(model.scene.xml, (d,)), noise)


def test_commands_stay_within_what_was_recorded():
    made = list(drive_motions(bench(), tilted=False))
    assert {"sweeps", "chirp", "slow reversals", "steps", "holds", "repeat at another speed"} <= {m.name for m in made}
    for motion in made:
        reach = motion.action["reach"]
        assert reach.value.min() >= -0.1 - 1e-9
        assert reach.value.max() <= 0.1 + 1e-9
        assert (np.diff(reach.time) > 0).all()
        speed = np.abs(np.diff(reach.value) / np.diff(reach.time))
        assert motion.name == "steps" or speed.max() <= 1.5 * 0.3 + 0.05, motion.name


def test_objects_that_are_out_of_the_way_are_not_measured():
    known = bench()
    sweep = next(m for m in drive_motions(known, tilted=False) if m.name == "sweeps")
    assert sweep.away == ("block",)
    assert "block out of the way" in sweep.text
    assert known.channels(sweep.away) == ["reach_position"]
    assert sweep.qpos[3] > 1


def test_push_without_a_grasp_leaves_the_gripper_and_moves_the_arm():
    known = bench()
    push = next(m for m in drive_motions(known, tilted=False) if m.name == "push without grasp")
    assert np.ptp(push.action["left"].value) == 0
    np.testing.assert_array_equal(push.action["reach"].value, known.longest.action["reach"].value)


def test_lighter_grip_closes_less():
    light = next(m for m in drive_motions(bench(), tilted=False) if m.name == "lighter grip")
    assert light.action["left"].value.max() == pytest.approx(0.7 * 0.02)
    assert np.ptp(light.action["reach"].value) == pytest.approx(0.2, rel=0.01)


@pytest.mark.parametrize("tilted", [False, True])
def test_the_slope_is_varied_only_where_it_is_adjustable(tilted):
    made = [*drive_motions(bench(), tilted), *body_motions(bench(), "mujoco", tilted)]
    assert any(m.change is slope_turned for m in made) == tilted


def test_turned_table_slopes_the_other_way_and_leaves_other_effects():
    model = Model(Scene(XML.format(shape=BOX))).add(GravityTilt(), [0.01, -0.02]).add(AirDrag("block"), [3.0])
    turned = slope_turned(model)
    assert [a.values for a in turned.effects] == [(-0.01, 0.02), (3.0,)]


def test_an_object_carries_two_weights_on_opposite_sides_that_lie_level():
    known = bench()
    body = known.m.body("block").id
    one, other = on_object(known, body)
    centre, each = known.m.body_ipos[body], 0.5 * MotionMenuCfg().extra_mass * known.m.body_mass[body]
    assert one.mass == other.mass == pytest.approx(each)
    np.testing.assert_allclose(np.add(one.position, other.position) / 2, centre, atol=1e-3)
    assert np.linalg.norm(np.subtract(one.position, other.position)) > 0.01
    assert one.position[2] == other.position[2]


def test_object_is_launched_from_where_it_rests():
    toy = ThrowableBody(bench(lift=0.1), bench().m.body("block").id, "mujoco")
    assert toy.rest is not None
    assert toy.rest[5] == pytest.approx(0.02, abs=1e-3)
    made = list(body_motions(bench(lift=0.1), "mujoco", tilted=False))
    slide, spin = (next(m for m in made if m.name == name) for name in ("slide", "spin in place"))
    assert slide.qpos[5] == pytest.approx(toy.rest[5])
    assert slide.qvel[3] > 0
    assert spin.qvel[8] == pytest.approx(3.0)
    assert {"drop", "throw", "slide of the turned object"} <= {m.name for m in made}


def test_spin_is_about_the_vertical_however_the_object_lies():
    known = bench()
    qpos = known.starts[0][0]
    toy = ThrowableBody(known, known.m.body("block").id, "mujoco")
    lying = toy.pose(qpos, np.zeros(3), np.array([np.pi / 2, 0, 0]))
    motion = toy.motion("spin", "spin", 1.0, lying, spin=(0, 0, 3.0))
    np.testing.assert_allclose(motion.qvel[6:9], [0, 3.0, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("shape", "direction"),
    [
        ('type="sphere" size=".02"', [1, 0, 0]),
        ('type="cylinder" size=".02 .03" euler="90 0 0"', [-1, 0, 0]),
        ('type="cylinder" size=".02 .02"', None),
        (BOX, None),
    ],
    ids=["ball", "lying cylinder", "standing cylinder", "box"],
)
def test_round_objects_roll_across_their_axis(shape, direction):
    known = bench(shape)
    rolling = _roll(ThrowableBody(known, known.m.body("block").id, "mujoco"), known.starts[0][0])
    if direction is None:
        assert rolling is None
    else:
        assert rolling is not None
        np.testing.assert_allclose(np.abs(rolling[0]), np.abs(direction), atol=1e-6)
        assert rolling[1] == pytest.approx(0.02)


def test_falling_object_without_a_table_is_only_thrown():
    xml = XML.format(shape=BOX).replace('<geom name="table" type="plane" size="2 2 .1"/>', "")
    known = bench(lift=0.3)
    loose = RecordedRange(Model(Scene(xml)), known.recording, known.noise)
    names = {m.name for m in body_motions(loose, "mujoco", tilted=False)}
    assert "throw" in names
    assert not names & {"slide", "spin in place", "roll", "drop"}
