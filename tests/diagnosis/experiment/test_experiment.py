import json

import mujoco
import numpy as np
import pytest

from concent_warp.diagnosis.experiment.future_window import future_window
from concent_warp.diagnosis.experiment.motions import ProposedMotion, RecordedRange
from concent_warp.diagnosis.experiment.suggest import (
    _separations,
    _start_effects,
    suggest_experiment,
)
from concent_warp.effects.library.contact import SlidingFriction, TorsionalFriction
from concent_warp.effects.library.joints import JointDamping, JointFriction
from concent_warp.effects.library.measurement import SensorBias
from concent_warp.effects.library.world import GravityTilt
from concent_warp.fit.effects.observe import channel_noises
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

CART = """
<mujoco><option timestep="0.004" integrator="implicitfast" gravity="0 0 0"/><worldbody>
  <body name="cart"><joint name="rail" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body>
</worldbody>
<actuator><position name="drive" joint="rail" kp="100" dampratio="1"/></actuator>
<sensor><jointpos name="rail_position" joint="rail"/></sensor></mujoco>"""
BLOCK = """
<mujoco><option timestep="0.002" integrator="implicitfast" cone="elliptic" impratio="5"/><worldbody>
  <geom name="table" type="plane" size="2 2 .1" friction=".3 .001" condim="4"/>
  <body name="block" pos="0 0 .01"><freejoint/>
    <geom type="box" size=".05 .04 .01" mass=".3" friction=".3 .001" condim="4"/></body>
</worldbody><sensor><framepos name="block_position" objtype="xbody" objname="block"/>
<framequat name="block_orientation" objtype="xbody" objname="block"/></sensor></mujoco>"""
NOISE = 3e-4


def one_speed() -> Recording:
    """A cart that is moved to and fro at 0.1 m/s."""
    time = np.arange(0, 4, 0.01)
    command = 0.1 * np.abs((time + 1) % 4 - 2) - 0.1
    m = mujoco.MjModel.from_xml_string(CART)
    d, read = mujoco.MjData(m), []
    for u in command:
        d.ctrl[0] = u
        read.append(d.qpos[0])
        mujoco.mj_step(m, d, nstep=2)
    channel = Channel(time, np.array(read)[:, None], noise_std=NOISE)
    demonstration = Demonstration(
        "sweep",
        qpos=np.zeros(1),
        qvel=np.zeros(1),
        action={"drive": Channel(time, command)},
        measured={"rail_position": channel},
    )
    return Recording(CART, (demonstration,))


def one_throw(speed: float = 0.6) -> Recording:
    """A block that slides along +x."""
    m = mujoco.MjModel.from_xml_string(BLOCK)
    d = mujoco.MjData(m)
    d.qvel[0] = speed
    qpos, qvel = d.qpos.copy(), d.qvel.copy()
    time, pose = np.arange(0, 0.5, 0.01), []
    for _ in time:
        pose.append(d.qpos.copy())
        mujoco.mj_step(m, d, nstep=5)
    values = np.array(pose)
    measured = {
        "block_position": Channel(time, values[:, :3], noise_std=NOISE),
        "block_orientation": Channel(time, values[:, 3:], noise_std=1.5e-3),
    }
    return Recording(BLOCK, (Demonstration("throw", qpos=qpos, qvel=qvel, measured=measured),))


def frictions() -> dict[str, Model]:
    """Coulomb friction and damping that are the same at 0.1 m/s."""
    plain = Model(Scene(CART))
    return {
        "joint_friction": plain.add(JointFriction("rail"), [0.5]),
        "joint_damping": plain.add(JointDamping("rail"), [5.0]),
    }


def test_frictions_alike_at_one_speed_are_distinguished_by_another():
    recording = one_speed()
    found = suggest_experiment(frictions(), recording)
    assert found is not None
    assert found.pair == ("joint_friction", "joint_damping")
    assert found.channel == "rail_position"
    bench = RecordedRange(Model(Scene(CART)), recording, channel_noises(Model(Scene(CART)), recording))
    d = recording.demonstrations[0]
    same = ProposedMotion("same", "do it again", 4.0, np.zeros(1), np.zeros(1), d.action)
    window = future_window(bench, same, same.duration)
    assert window is not None
    again = _separations(frictions(), same, window, "mujoco")
    assert again is not None
    assert found.separation > 2 * again[found.pair][0]


def test_sentence_says_what_to_do_and_by_how_much_hypotheses_differ():
    found = suggest_experiment(frictions(), one_speed())
    assert found is not None
    assert "drive" in found.sentence or "same commands" in found.sentence
    assert "joint_friction and joint_damping then differ by" in found.sentence
    assert found.sentence.endswith(" noise (rail position).")


def test_friction_of_a_twist_is_distinguished_from_sliding_friction_by_a_spin():
    plain = Model(Scene(BLOCK))
    m = plain.compile()
    twist = TorsionalFriction("block")
    models = {
        "torsional_friction": plain.add(twist, [twist.parameters(m)[0].null + 0.01]),
        "sliding_friction": plain.add(SlidingFriction("block"), [0.3]),
    }
    found = suggest_experiment(models, one_throw())
    assert found is not None
    assert "spin" in found.sentence
    assert found.channel == "block_orientation"
    assert found.separation > 2


@pytest.mark.parametrize("count", [1, 2])
def test_hypotheses_that_predict_the_same_are_not_distinguished(count):
    model = Model(Scene(CART)).add(JointFriction("rail"), [0.5])
    assert suggest_experiment({f"h{k}": model for k in range(count)}, one_speed()) is None


def test_slope_is_distinguished_from_a_throw_the_other_way_round():
    plain = Model(Scene(BLOCK))
    tilt = plain.add(GravityTilt(), [0.0, 0.02])
    friction = plain.add(SlidingFriction("block"), [0.3 + 0.02])
    found = suggest_experiment({"gravity_tilt": tilt, "sliding_friction": friction}, one_throw())
    assert found is not None
    assert found.separation > 2
    assert any(way in found.sentence for way in ("-x", "y", "turn the table"))


def test_what_an_error_of_the_start_explains_does_not_count():
    plain = Model(Scene(CART.replace("<actuator>", "<!--").replace("</actuator>", "-->")))
    biased = plain.add(SensorBias("rail_position"), [2 * NOISE])
    time = np.arange(0, 1, 0.01)
    channel = Channel(time, 0 * time[:, None], noise_std=NOISE)
    at_rest = Demonstration("rest", qpos=np.zeros(1), qvel=np.zeros(1), measured={"rail_position": channel})
    bench = RecordedRange(plain, Recording(plain.scene.xml, (at_rest,)), {"rail_position": NOISE})
    motion = ProposedMotion("coast", "let it coast", 1.0, np.zeros(1), np.array([0.1]))
    window = future_window(bench, motion, 1.0)
    assert window is not None
    models = {"plain": plain, "biased": biased}
    raw = _separations(models, motion, window, "mujoco")
    starts = _start_effects(plain, window, "mujoco", 0.1)
    assert raw is not None
    assert raw["plain", "biased"][0] == pytest.approx(2.0, rel=1e-6)
    left = _separations(models, motion, window, "mujoco", starts)
    assert left is not None
    assert left["plain", "biased"][0] < 0.05


def test_motion_in_which_a_model_diverges_is_left_out():
    plain = Model(Scene(CART))
    recording = one_speed()
    bench = RecordedRange(plain, recording, {"rail_position": NOISE})
    motion = ProposedMotion("burst", "burst", 0.5, np.zeros(1), np.array([1e12]), recording.demonstrations[0].action)
    window = future_window(bench, motion, 0.5)
    assert window is not None
    assert _separations({"a": plain, "b": plain}, motion, window, "mujoco") is None


def test_the_experiment_has_the_motion_as_arrays_with_units(tmp_path):
    shares = []
    path = tmp_path / "experiment.json"
    found = suggest_experiment(frictions(), one_speed(), out=path, progress=shares.append)
    assert found is not None
    command, rail = found.motion.commands["drive"], found.motion.joints["rail"]
    assert (command.unit, rail.unit) == ("m", "m")
    assert rail.value.shape == rail.time.shape
    assert rail.time[-1] == pytest.approx(found.motion.duration, abs=0.01)
    followed = np.interp(rail.time, command.time, command.value)
    assert np.sqrt(np.mean((rail.value - followed) ** 2)) < 0.02
    assert set(found.predictions) == {"joint_friction", "joint_damping"}
    one, other = (found.predictions[name].value for name in found.pair)
    assert np.sqrt(np.mean((one - other) ** 2)) > 0.5 * found.separation * NOISE
    document = json.loads(path.read_text())
    assert document["motion"]["commands"]["drive"]["value"] == command.value.tolist()
    assert document["sentence"] == found.sentence
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_the_motion_of_an_object_starts_as_it_is_to_be_pushed():
    plain = Model(Scene(BLOCK))
    tilt, friction = plain.add(GravityTilt(), [0.0, 0.02]), plain.add(SlidingFriction("block"), [0.32])
    found = suggest_experiment({"gravity_tilt": tilt, "sliding_friction": friction}, one_throw())
    assert found is not None
    block = found.motion.objects["block"]
    assert block.position.shape == block.velocity.shape == block.angular_velocity.shape == (len(block.time), 3)
    assert np.linalg.norm(block.orientation, axis=1) == pytest.approx(1.0)
    assert np.linalg.norm(block.velocity[0]) > 0.1
    assert np.linalg.norm(block.velocity[-1]) < np.linalg.norm(block.velocity[0])
    moved = (block.position[1] - block.position[0]) / (block.time[1] - block.time[0])
    assert moved == pytest.approx(block.velocity[0], abs=0.05)
