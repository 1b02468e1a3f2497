import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.diagnosis.forces.cfg import FeatureCfg, LocateForcesCfg
from concent_warp.diagnosis.forces.features import DIRECTION, joint_features
from concent_warp.diagnosis.forces.window_forces import window_forces
from concent_warp.diagnosis.forces.window_solver import _misfit, _response
from concent_warp.estimation.smoothing_spline import ChannelReadings, angular_velocity, fit_spline
from concent_warp.estimation.state_estimator import StateEstimator, StateEstimatorCfg
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration
from concent_warp.scene.scene import Scene
from concent_warp.simulate.mujoco_engine import MujocoEngine
from tests.diagnosis.forces.locate_scenes import swing, throw


def windows_of(recording, cfg=None, which=0):
    model = Model(Scene(recording.scene))
    engine = MujocoEngine(model, threads=1)
    motion = StateEstimator.of(model, recording[which], StateEstimatorCfg("smoothing_spline"), engine=engine)
    return window_forces(recording[which].name, engine, motion, cfg or LocateForcesCfg(extra_starts=1)), motion


def wave(seed, count=600, noise=1e-3):
    rng = np.random.default_rng(seed)
    time = np.sort(rng.uniform(0, 4, count))
    value = 0.5 * np.sin(3 * time)[:, None] + rng.normal(0, noise, (count, 1))
    return time, value


def test_smoothed_motion_and_its_errors_agree_with_the_truth():
    at = np.linspace(0.3, 3.7, 30)
    truth = np.stack([0.5 * np.sin(3 * at), 1.5 * np.cos(3 * at), -4.5 * np.sin(3 * at)])
    off = []
    for seed in range(8):
        found = fit_spline(*wave(seed), 1e-3)
        std = np.sqrt(np.einsum("tii->it", found.covariance(at)))
        off.append([(found.at(at, k)[:, 0] - truth[k]) / std[k] for k in range(3)])
    spread = np.sqrt(np.mean(np.square(off), axis=(0, 2)))
    assert (spread < 1.2).all()
    assert spread[0] > 0.6
    assert spread[1] > 0.4


def test_readings_of_the_velocity_make_it_more_certain():
    time, value = wave(0)
    speed = 1.5 * np.cos(3 * time)[:, None] + np.random.default_rng(1).normal(0, 5e-3, (len(time), 1))
    alone, both = fit_spline(time, value, 1e-3), fit_spline(time, value, 1e-3, ChannelReadings(time, speed, 5e-3))
    at = np.array([1.0, 2.0])
    assert (both.covariance(at)[:, 1, 1] < 0.5 * alone.covariance(at)[:, 1, 1]).all()
    assert both.at(at, 1)[:, 0] == pytest.approx(1.5 * np.cos(3 * at), abs=5e-3)


def test_gaps_are_bridged_with_larger_errors():
    time, value = wave(0)
    value[(time > 1.5) & (time < 1.8)] = np.nan
    found = fit_spline(time, value, 1e-3)
    inside, outside = found.covariance(np.array([1.65, 1.0]))[:, 0, 0]
    assert inside > 4 * outside
    assert np.isfinite(found.at(np.array([1.65]))).all()


def test_too_few_readings_are_not_smoothed():
    assert fit_spline(np.arange(4.0), np.zeros((4, 1)), 1e-3) is None


def test_angular_velocity_follows_from_the_quaternion_and_its_rate():
    omega, step = np.array([0.3, -1.0, 2.0]), 1e-6
    start = Rotation.from_euler("xyz", [0.4, 0.2, -1.0])
    ends = [start * Rotation.from_rotvec(s * omega) for s in (-step, step)]
    rate = (ends[1].as_quat(scalar_first=True) - ends[0].as_quat(scalar_first=True)) / (2 * step)
    assert angular_velocity(start.as_quat(scalar_first=True), rate) == pytest.approx(omega, abs=1e-6)


def test_deviations_of_a_spring_oscillate_about_its_static_deflection():
    omega, length = 30.0, 0.1
    response = _response(np.array([[-(omega**2)]]), np.zeros((1, 1)), length, 40)
    s = np.linspace(0, length, len(response))
    assert response[:, 0, 0] == pytest.approx(np.cos(omega * s), abs=1e-9)
    assert response[:, 0, 1] == pytest.approx(np.sin(omega * s) / omega, abs=1e-9)
    assert response[:, 0, 2] == pytest.approx((1 - np.cos(omega * s)) / omega**2, abs=1e-9)


def test_variance_grows_only_where_the_misfit_is_significant():
    assert _misfit(30.0, 30, 3.0) == 1
    assert _misfit(40.0, 30, 3.0) == 1
    assert _misfit(90.0, 30, 3.0) == 3
    assert _misfit(5.0, 0, 3.0) == 1


def test_a_constant_torque_on_a_driven_joint_is_found_without_bias_and_with_its_error():
    found, _ = windows_of(swing(lambda _: 0.01, duration=4))
    off = (found.force[:, 0] - 0.01) / found.std[:, 0]
    assert found.force[:, 0].mean() == pytest.approx(0.01, rel=0.02)
    assert off.std() == pytest.approx(1, abs=0.25)


def test_wider_windows_see_smaller_forces():
    recording = swing(lambda _: 0.0, duration=2)
    short, long = (np.median(windows_of(recording, LocateForcesCfg(w, extra_starts=0))[0].std) for w in (0.08, 0.16))
    assert long < 0.4 * short


def test_force_on_a_flying_body_is_that_in_the_world_and_its_torque_that_about_the_origin():
    force, point = np.array([0.0, -0.5, 0.2]), np.array([0.02, 0.03, -0.01])
    found, motion = windows_of(throw(force, point, fly=True, count=1, duration=0.35, noise=(1e-5, 1e-4)))
    turn = Rotation.from_quat(found.qpos[:, 3:7], scalar_first=True)
    assert found.force[:, :3] == pytest.approx(turn.apply(force), abs=0.03)
    assert found.force[:, 3:] == pytest.approx(np.tile(np.cross(point, force), (len(turn), 1)), abs=1e-3)
    assert motion.bodies[0].name == "block"


def test_without_orientation_the_force_is_known_and_the_torque_is_not():
    recording = throw((0, -0.5, 0), fly=True, count=1, world=True)
    first = recording[0]
    measured = {"block_position": first.measured["block_position"]}
    lone = Demonstration("demo_0", qpos=first.qpos, measured=measured)
    found, _ = windows_of(type(recording)(recording.scene, (lone,)))
    assert found.force[:, 1].mean() == pytest.approx(-0.5, abs=0.1)
    assert np.isnan(found.force[:, 3:]).all()


def test_windows_with_too_few_readings_have_no_information():
    recording = swing(lambda _: 0.0, duration=2)
    channel = recording[0].measured["angle"]
    kept = (channel.time < 0.8) | (channel.time > 1.2)
    measured = {"angle": Channel(channel.time[kept], channel.value[kept], noise_std=channel.noise_std)}
    holed = Demonstration("demo_0", qpos=np.zeros(1), action=recording[0].action, measured=measured)
    found, _ = windows_of(type(recording)(recording.scene, (holed,)))
    inside = (found.start > 0.8) & (found.start + found.length < 1.2)
    assert inside.any()
    assert np.isnan(found.force[inside]).all()
    assert np.isfinite(found.force[found.start + found.length < 0.8]).all()


def test_features_of_a_joint_are_averaged_over_the_window():
    found, motion = windows_of(swing(lambda _: 0.0, duration=2))
    direction = joint_features(found, motion, FeatureCfg())["hinge"][DIRECTION][:, 0]
    assert np.abs(direction).max() == pytest.approx(1, abs=0.02)
    turning_point = np.abs(direction) < 0.5
    assert 0 < turning_point.sum() < len(direction) / 2
