"""Measured motion of ball joints, on a body that hangs askew from a slide."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.errors import RecordingError
from concent_warp.estimation.partial_state import partial_state
from concent_warp.estimation.state_estimator import StateEstimator, StateEstimatorCfg
from concent_warp.fit.effects.observation import start_spread
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene

HANGING = """<mujoco><option timestep="0.001"/><worldbody>
<body pos="0 0 1" euler="0 30 0"><joint name="rail" type="slide"/>
<geom size=".02" mass=".2"/><body name="rod" pos="0 0 -.1" euler="40 0 20"><joint name="ball" type="ball"/>
<geom type="box" size=".02 .03 .1" pos="0 0 -.1" mass=".3"/><site name="tag" pos="0 .02 -.1" euler="90 0 10"/>
</body></body></worldbody>
<sensor><jointpos name="carriage" joint="rail"/>
<ballquat name="turn" joint="ball"/><ballangvel name="spin" joint="ball"/>
<framequat name="marker" objtype="site" objname="tag"/><gyro name="rate" site="tag"/></sensor></mujoco>"""
TIME = np.arange(0, 0.6, 0.005)


@pytest.fixture(scope="module")
def swung() -> tuple[Demonstration, np.ndarray, np.ndarray]:
    """Return a demonstration with all sensors, and its states, from a turn that is not small."""
    m = Scene(HANGING).model
    d = mujoco.MjData(m)
    d.qpos[1:] = Rotation.from_rotvec([0.5, -0.4, 0.9]).as_quat(scalar_first=True)
    d.qvel[:] = 0.1, 1.0, -2.0, 3.0
    qpos, qvel, read = [], [], []
    for k in range(round(TIME[-1] / m.opt.timestep) + 1):
        if k % 5 == 0:
            mujoco.mj_forward(m, d)
            qpos.append(d.qpos.copy())
            qvel.append(d.qvel.copy())
            read.append(d.sensordata.copy())
        mujoco.mj_step(m, d)
    measured = {}
    for name in ("carriage", "turn", "spin", "marker", "rate"):
        first, dim = int(m.sensor(name).adr[0]), int(m.sensor(name).dim[0])
        measured[name] = Channel(TIME, np.array(read)[:, first : first + dim])
    return Demonstration("demo_0", measured=measured), np.array(qpos), np.array(qvel)


def only(d: Demonstration, *names: str) -> Demonstration:
    """Return a demonstration with some of its channels."""
    return Demonstration(d.name, measured={name: d.measured[name] for name in names})


@pytest.mark.parametrize("method", ["local_polynomial", "smoothing_spline"])
@pytest.mark.parametrize("channels", [("turn",), ("turn", "spin"), ("marker",), ("marker", "rate")])
def test_the_rotation_and_its_rate_are_those_of_the_simulation(swung, channels, method):
    whole, qpos, qvel = swung
    d, rows = only(whole, "carriage", *channels), slice(20, 100, 10)
    estimator = StateEstimator.of(Model(Scene(HANGING)), d, StateEstimatorCfg(method=method))
    found = estimator.states(TIME[rows])
    same = np.abs((found.qpos[:, 1:] * qpos[rows, 1:]).sum(axis=1))
    assert same == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(found.qvel[:, 1:], qvel[rows, 1:], atol=0.05)
    assert np.isfinite(estimator.standard_errors(TIME[rows]).velocity[:, 1:]).all()
    samples, _ = estimator.sample_states(TIME[rows], 2, np.random.default_rng(0))
    assert np.linalg.norm(samples[:, :, 1:], axis=2) == pytest.approx(1.0)


def test_a_ball_joint_that_nothing_measured_is_asked_for(swung):
    with pytest.raises(RecordingError, match=r"ball joint was not measured.*ballquat"):
        StateEstimator.of(Model(Scene(HANGING)), only(swung[0], "carriage"))


def test_the_orientation_of_a_body_on_a_hinge_below_is_not_that_of_its_ball_joint(swung):
    scene = Scene(HANGING.replace('type="slide"', 'axis="0 1 0"'))
    with pytest.raises(RecordingError, match="ball joint was not measured"):
        StateEstimator.of(Model(scene), only(swung[0], "carriage", "marker"))


def test_a_partly_measured_state_has_the_ball_joint(swung):
    whole, qpos, qvel = swung
    m, cfg = Scene(HANGING).model, ObservationCfg()
    found = partial_state(m, only(whole, "marker"), TIME[50])
    assert found.measured.tolist() == [False, True, True, True]
    assert abs(found.qpos[1:] @ qpos[50, 1:]) == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(found.qvel[1:], qvel[50, 1:], atol=0.05)
    spread = start_spread(m, {"marker": 0.01}, measured=found.measured)
    np.testing.assert_allclose(spread[1:4], cfg.state_noise * 0.01)
    unseen = start_spread(m, {"marker": 0.01}, measured=np.zeros(4, bool))
    np.testing.assert_allclose(unseen[1:4], cfg.unknown_orientation)
