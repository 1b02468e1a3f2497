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
    model, _, seen = swing()
    with pytest.raises(RecordingError, match="joints were not measured"):
        StateEstimator.of(model, only(seen, "elbow"))
    assert marked_joints(model.scene.model, only(seen, "elbow"), np.arange(2)) is None


def test_a_joint_with_an_encoder_keeps_its_own_spread():
    scene = SCENE.replace("FRAME", "").replace("</sensor>", '<jointpos name="angle" joint="j0"/></sensor>')
    m = mujoco.MjModel.from_xml_string(scene)
    spread = start_spread(m, {"angle": 1e-4, "tip": 1e-3})
    assert spread[0] == pytest.approx(3e-4)
    assert spread[1] == pytest.approx(3e-3 / 0.22)
