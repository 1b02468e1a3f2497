import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.errors import RecordingError
from concent_warp.estimation.smoothing_spline import angular_acceleration, angular_velocity
from concent_warp.estimation.state_estimator import StateEstimator, StateEstimatorCfg
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene
from concent_warp.simulate.mujoco_engine import MujocoEngine

SPLINE = StateEstimatorCfg("smoothing_spline")
SCENE = """
<mujoco>
  <worldbody>
    <body><joint name="arm" type="hinge"/><geom size="0.1"/></body>
    <body name="ball"><freejoint/><geom size="0.1" contype="0" conaffinity="0"/><site name="imu"/></body>
  </worldbody>
  <sensor>
    <jointpos name="angle" joint="arm"/><jointvel name="rate" joint="arm"/>
    <framepos name="position" objtype="xbody" objname="ball"/>
    <framequat name="orientation" objtype="xbody" objname="ball"/>
  </sensor>
</mujoco>"""
ANGLE, METRE, TURN = 1e-3, 5e-4, 2e-3


def truth(time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return position, velocity and acceleration of hinge and ball, and the ball's rotation about z, each (T, 5)."""
    wave = np.stack([0.4 * np.sin(2 * time), 0.2 * np.cos(3 * time), 0.1 * time, 0.3 * np.sin(time), np.sin(2 * time)])
    rate = np.stack(
        [0.8 * np.cos(2 * time), -0.6 * np.sin(3 * time), 0.1 + 0 * time, 0.3 * np.cos(time), 2 * np.cos(2 * time)]
    )
    second = np.stack(
        [-1.6 * np.sin(2 * time), -1.8 * np.cos(3 * time), 0 * time, -0.3 * np.sin(time), -4 * np.sin(2 * time)]
    )
    return wave.T, rate.T, second.T


def recorded(seed: int, rate_noise: float = 1.0) -> Demonstration:
    """Return noisy measurements of that motion."""
    rng = np.random.default_rng(seed)
    time = 0.01 * np.arange(200)
    value, rate, _ = truth(time)
    turn = Rotation.from_rotvec(value[:, 4:] * [0, 0, 1]) * Rotation.from_rotvec(TURN * rng.normal(size=(200, 3)))
    return Demonstration(
        "demo_0",
        measured={
            "angle": Channel(time, value[:, :1] + ANGLE * rng.normal(size=(200, 1)), ANGLE),
            "rate": Channel(time, rate[:, :1] + rate_noise * rng.normal(size=(200, 1)), rate_noise),
            "position": Channel(time, value[:, 1:4] + METRE * rng.normal(size=(200, 3)), METRE),
            "orientation": Channel(time, turn.as_quat(scalar_first=True), TURN),
        },
    )


def columns(states: np.ndarray) -> np.ndarray:
    """Return hinge, ball and rotation about z of velocities (T, 7)."""
    return states[:, [0, 1, 2, 3, 6]]


@pytest.mark.parametrize("cfg", [StateEstimatorCfg(), SPLINE])
def test_departures_from_the_truth_are_as_large_as_the_standard_errors(cfg):
    time = np.linspace(0.2, 1.8, 40)
    value, rate, second = truth(time)
    squares = []
    for seed in range(6):
        estimator = StateEstimator.of(Model(Scene(SCENE)), recorded(seed), cfg)
        states, errors = estimator.states(time), estimator.standard_errors(time)
        turn = 2 * np.arctan2(states.qpos[:, 7], states.qpos[:, 4])
        position = np.concatenate([states.qpos[:, :4], turn[:, None]], axis=1)
        squares.append(
            [
                ((position - value) / columns(errors.position)) ** 2,
                ((columns(states.qvel) - rate) / columns(errors.velocity)) ** 2,
                ((columns(states.qacc) - second) / columns(errors.acceleration)) ** 2,
            ]
        )
    # The median of a squared standard normal deviate is 0.455. Polynomials estimate the noise from few readings;
    # splines allow for a jerk of white noise, which this motion lacks: their errors are at most 3 times too large.
    ratio = np.median(np.array(squares), axis=(0, 2)) / 0.455
    assert np.all(ratio > 1 / 9)
    assert np.all(ratio < 3)


@pytest.mark.parametrize("cfg", [StateEstimatorCfg(), SPLINE])
def test_samples_of_states_scatter_by_the_standard_errors(cfg):
    time = np.array([0.5, 1.1])
    estimator = StateEstimator.of(Model(Scene(SCENE)), recorded(0), cfg)
    qpos, qvel = estimator.sample_states(time, 2000, np.random.default_rng(0))
    states, errors = estimator.states(time), estimator.standard_errors(time)
    np.testing.assert_allclose(qpos[0], states.qpos)
    np.testing.assert_allclose(qvel[0], states.qvel)
    np.testing.assert_allclose(qpos[1:, :, :4].std(axis=0), errors.position[:, :4], rtol=0.08)
    np.testing.assert_allclose(qvel[1:].std(axis=0), errors.velocity, rtol=0.08)
    np.testing.assert_allclose(2 * qpos[1:, :, 5:].std(axis=0).min(axis=1), errors.position[:, 4], rtol=0.15)


@pytest.mark.parametrize("cfg", [StateEstimatorCfg(), SPLINE])
def test_a_velocity_sensor_reduces_the_error_of_the_velocity(cfg):
    time = np.linspace(0.2, 1.8, 20)
    poor, good = (
        StateEstimator.of(Model(Scene(SCENE)), recorded(0, noise), cfg).standard_errors(time).velocity[:, 0]
        for noise in (1.0, 1e-3)
    )
    assert np.median(good) < 0.3 * np.median(poor)


def test_a_jump_shows_in_the_scatter_of_the_readings_about_a_spline():
    demonstration = recorded(0)
    demonstration.measured["position"].value[100:] += 0.02
    time = np.linspace(0.2, 1.8, 81)
    scatter = StateEstimator.of(Model(Scene(SCENE)), demonstration, SPLINE).scatter(time)
    assert abs(time[scatter.argmax()] - 1.0) < 0.05
    assert scatter.max() > 3 * np.median(scatter)


def test_an_impact_shows_in_the_scatter_also_where_the_readings_on_one_side_are_smooth():
    demonstration = recorded(0)
    time = demonstration.measured["position"].time
    demonstration.measured["position"].value[:] += 2.0 * np.maximum(time - 1.0, 0.0)[:, None]
    near = np.array([0.995, 1.0, 1.005, 1.015])
    measured, times = StateEstimator.of(Model(Scene(SCENE)), demonstration), np.linspace(0.2, 0.9, 40)
    scatter = measured.scatter_of_both_sides(np.concatenate([near, times]))
    assert scatter[: len(near)].min() > max(3.0, scatter[len(near) :].max())


def test_angular_motion_of_a_quaternion_agrees_with_finite_differences():
    def at(t: float) -> np.ndarray:
        turn = Rotation.from_rotvec([0.3 * t**2, 0.5 * t, -0.2 * t**3]) * Rotation.from_rotvec([0, t**2, 0])
        return (1 + 0.1 * t) * turn.as_quat(scalar_first=True)

    def spin(t: float) -> np.ndarray:
        return angular_velocity(at(t), (at(t + h) - at(t - h)) / (2 * h))

    h, now = 1e-4, 0.7
    rate, second = (at(now + h) - at(now - h)) / (2 * h), (at(now + h) - 2 * at(now) + at(now - h)) / h**2
    nearby = [Rotation.from_quat(at(now + s), scalar_first=True) for s in (-h, h)]
    np.testing.assert_allclose(spin(now), (nearby[0].inv() * nearby[1]).as_rotvec() / (2 * h), atol=1e-5)
    numerical = (spin(now + h) - spin(now - h)) / (2 * h)
    np.testing.assert_allclose(angular_acceleration(at(now), rate, second), numerical, atol=1e-4)


def test_what_was_not_measured_is_simulated_or_refused():
    model = Model(Scene(SCENE))
    full = recorded(0)
    partial = Demonstration("demo_0", measured={name: full.measured[name] for name in ("angle", "rate")})
    with pytest.raises(RecordingError, match="free body was not seen"):
        StateEstimator.of(model, partial)
    with pytest.raises(RecordingError, match="some joints or free bodies were not measured"):
        StateEstimator.of(model, partial, SPLINE)
    estimator = StateEstimator.of(model, partial, SPLINE, engine=MujocoEngine(model, threads=1))
    height = estimator.states(np.array([1.0])).qpos[0, 3]
    assert height == pytest.approx(model.compile().opt.gravity[2] / 2, rel=0.01)
    assert np.isnan(estimator.standard_errors(np.array([1.0])).position[0, 1:]).all()
