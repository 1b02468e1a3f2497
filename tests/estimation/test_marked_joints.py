"""A double pendulum whose joints no encoder reads: markers on its links tell them."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.estimation.marked_joints import marked_joints
from concent_warp.estimation.state_estimator import StateEstimator
from concent_warp.fit.effects.observation import start_spread
from concent_warp.fit.effects.observe import observe
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from concent_warp.simulate.replay import initial_state

SCENE = """<mujoco><option timestep="0.001"/><worldbody><body name="camera" pos="0.3 -2 1" euler="90 0 20"/>
<body name="upper" pos="0 0 1"><joint name="j0" axis="0 1 0"/><geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.25"
mass="0.3" contype="0" conaffinity="0"/><site name="m0" pos="0.02 0 -0.25"/>
<body name="lower" pos="0 0 -0.25"><joint name="j1" axis="0 1 0"/><geom type="capsule" size="0.01"
fromto="0 0 0 0 0 -0.22" mass="0.2" contype="0" conaffinity="0"/><site name="m1" pos="0 0 -0.22"/></body></body>
</worldbody><sensor><framepos name="elbow" objtype="site" objname="m0" FRAME/>
<framepos name="tip" objtype="site" objname="m1" FRAME/><framequat name="turn" objtype="site" objname="m1" FRAME/>
</sensor></mujoco>"""
WORLD, CAMERA = "", 'reftype="xbody" refname="camera"'
STEPS, EVERY, NOISE = 2500, 10, 5e-4


def swing(frame=WORLD, start=(1.0, -0.4), noise=NOISE):
    """The pendulum, its true states (T, 4), and what a tracker reads of it, which begins in the motion."""
    scene = SCENE.replace("FRAME", frame)
    m = mujoco.MjModel.from_xml_string(scene)
    d, rng = mujoco.MjData(m), np.random.default_rng(0)
    d.qpos[:] = start
    states, read = [], []
    for k in range(STEPS + 300):
        mujoco.mj_forward(m, d)
        if k >= 300 and k % EVERY == 0:
            states.append(np.concatenate([d.qpos, d.qvel]))
            read.append(d.sensordata.copy())
        mujoco.mj_step(m, d)
    read = np.array(read)
    read[:, :6] += rng.normal(0, noise, (len(read), 6))
    time = np.arange(len(read)) * EVERY * 1e-3
    measured = {
        "elbow": Channel(time, read[:, :3], noise),
        "tip": Channel(time, read[:, 3:6], noise),
        "turn": Channel(time, read[:, 6:], 1e-3),
    }
    return Model(Scene(scene)), np.array(states), Demonstration("demo_0", measured=measured)


def only(demonstration, *names):
    return replace(demonstration, measured={name: demonstration.measured[name] for name in names})


@pytest.mark.parametrize("frame", [WORLD, CAMERA])
@pytest.mark.parametrize("names", [("elbow", "tip"), ("turn", "elbow")])
def test_markers_tell_joints_at_all_times(frame, names):
    model, states, seen = swing(frame)
    found = StateEstimator.of(model, only(seen, *names)).states(seen.measured["tip"].time[5:-5])
    np.testing.assert_allclose(found.qpos, states[5:-5, :2], atol=0.02)
    assert np.sqrt(np.mean((found.qvel - states[5:-5, 2:]) ** 2)) < 0.3


def test_coordinates_that_were_not_read_lost_markers_and_other_times_are_left_aside():
    model, states, seen = swing()
    elbow, tip = (np.array(seen.measured[name].value) for name in ("elbow", "tip"))
    elbow[:, 1] = tip[:, 1] = np.nan
    elbow[40:44] = tip[100:130] = np.nan
    time = seen.measured["tip"].time
    between = (elbow[1:] + elbow[:-1]) / 2
    moved = replace(seen, measured={"elbow": Channel((time[1:] + time[:-1]) / 2, between), "tip": Channel(time, tip)})
    told = marked_joints(model.scene.model, moved, np.arange(2))
    assert told is not None
    at, value = told
    assert not ((at > time[102]) & (at < time[127])).any()
    true = np.stack([np.interp(at, time, column) for column in states[:, :2].T], axis=1)
    np.testing.assert_allclose(value, true, atol=0.02)
    qpos, _ = initial_state(model.scene.model, moved)
    np.testing.assert_allclose(qpos, states[0, :2], atol=0.02)


def test_windows_start_in_the_motion_within_their_spread():
    model, states, seen = swing()
    recording = Recording(model.scene.xml, (only(seen, "elbow", "tip"),))
    windows = observe(model, recording, length=0.8)
    assert len(windows) > 2
    for w in windows:
        row = round(w.start / (EVERY * 1e-3))
        off = np.concatenate([w.qpos, w.qvel]) - states[row]
        at_the_edge = w.start == 0  # where velocities are extrapolated
        assert (np.abs(off) < (10 if at_the_edge else 2) * w.spread).all()


def test_one_marker_on_the_first_link_tells_nothing_of_the_second():
    model, states, seen = swing()
    with pytest.raises(RecordingError, match="joints were not measured"):
        StateEstimator.of(model, only(seen, "elbow"))
    told = marked_joints(model.scene.model, only(seen, "elbow"), np.arange(2))
    assert told is not None
    np.testing.assert_allclose(told[1][:, 0], states[:, 0], atol=0.02)
    assert np.isnan(told[1][:, 1]).all()
    assert marked_joints(model.scene.model, only(seen, "elbow"), np.array([1])) is None


def test_a_joint_with_an_encoder_keeps_its_own_spread():
    scene = SCENE.replace("FRAME", "").replace("</sensor>", '<jointpos name="angle" joint="j0"/></sensor>')
    m = mujoco.MjModel.from_xml_string(scene)
    spread = start_spread(m, {"angle": 1e-4, "tip": 1e-3})
    assert spread[0] == pytest.approx(3e-4)
    assert spread[1] == pytest.approx(3e-3 / 0.22)


PUCK = """<mujoco><option timestep="0.001"/><worldbody><body name="puck"><joint name="x" type="slide" axis="1 0 0"/>
<joint name="y" type="slide" axis="0 1 0"/><joint name="heading" axis="0 0 1"/><geom type="cylinder" size="0.05 0.01"
contype="0" conaffinity="0"/><site name="dot" pos="0.04 0 0"/></body>
<body name="gauge" pos="1 0 0"><joint name="unread"/><geom size="0.01" contype="0" conaffinity="0"/></body></worldbody>
<sensor><framepos name="dot_position" objtype="site" objname="dot"/><jointpos name="heading" joint="heading"/>
</sensor></mujoco>"""


@pytest.mark.parametrize("all_read", [True, False])
def test_a_marker_tells_the_joints_without_a_sensor_beside_one_that_has_its_own(all_read):
    scene = PUCK if all_read is False else PUCK.replace('<joint name="unread"/>', "")
    time, rng = np.arange(0, 1, 0.01), np.random.default_rng(0)
    x, y, heading = 0.3 - 0.8 * time, 0.1 * np.sin(3 * time), 0.5 + 2 * time
    dot = np.stack([x + 0.04 * np.cos(heading), y + 0.04 * np.sin(heading), np.full_like(x, np.nan)], axis=1)
    dot += rng.normal(0, NOISE, dot.shape)
    measured = {"dot_position": Channel(time, dot, NOISE), "heading": Channel(time, heading[:, None], 1e-4)}
    seen = Demonstration("demo_0", measured=measured)
    model = Model(Scene(scene))
    (window,) = observe(model, Recording(scene, (seen,)), length=2.0)
    at = float(window.start)
    expected = [0.3 - 0.8 * at, 0.1 * np.sin(3 * at), 0.5 + 2 * at], [-0.8, 0.3 * np.cos(3 * at), 2.0]
    assert window.qpos[:3] == pytest.approx(expected[0], abs=2e-3)
    assert window.qvel[:3] == pytest.approx(expected[1], abs=0.1)
    spread = window.spread.reshape(2, -1)
    assert (np.abs(window.qvel[:2] - expected[1][:2]) < 4 * spread[1, :2]).all()
    # What nothing tells is where the model has it, as uncertain as such joints are.
    if not all_read:
        assert window.qpos[3] == window.qvel[3] == 0.0
        unmeasured = start_spread(model.scene.model, {}, measured=np.zeros(4, dtype=bool))
        assert spread[:, 3] == pytest.approx(unmeasured.reshape(2, -1)[:, 3])


def test_joints_that_no_pose_depends_on_leave_the_others_told():
    time = np.arange(0, 0.5, 0.01)
    dot = np.stack([0.5 * time + 0.04, 0 * time, 0 * time], axis=1)
    seen = Demonstration("demo_0", measured={"dot_position": Channel(time, dot, NOISE)})
    m = Model(
        Scene(PUCK.replace('<joint name="heading" axis="0 0 1"/>', "").replace('joint="heading"', 'joint="x"'))
    ).scene.model
    told = marked_joints(m, seen, np.arange(3))
    assert told is not None
    at, value = told
    np.testing.assert_allclose(value[:, 0], 0.5 * at, atol=1e-6)
    assert np.isnan(value[:, 2]).all()
