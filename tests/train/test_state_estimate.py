"""The state as a controller knows it: encoder readings and tracked poses, on poses that tests choose."""

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from made_up_task import make_task

from concent_warp.errors import TrainError
from concent_warp.train.cfg import TrainCfg
from concent_warp.train.environment.physics import Physics
from concent_warp.train.environment.quaternions import (
    invert_quaternion,
    multiply_quaternions,
    rotate_vectors,
    rotation_from_vector,
)
from concent_warp.train.environment.state_estimate import FIRST_FRAMES, StateEstimate
from concent_warp.train.observation_cfg import ObservationCfg, SensorErrorsCfg

TASK = make_task()
HAND = int(TASK.compiled.site_bodyid[TASK.robot.tool])
FREE, FIXED = (0, 2), 1
"""Objects by their place in `Task.objects`."""
FAULTLESS = SensorErrorsCfg(encoder_std=0.0, encoder_step=0.0, position_std=0.0, orientation_std=0.0, dropout=0.0)
SMOOTHING = 0.2


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """Use one thread: the tensors are small."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


class ChosenPoses:
    """Worlds whose poses tests set; the estimated hand is where the true one is."""

    def __init__(self, worlds: int) -> None:
        m, self.worlds, self.device = TASK.compiled, worlds, "cpu"
        self.qpos = torch.from_numpy(np.tile(m.qpos0, (worlds, 1)))
        self.ctrl = torch.zeros(worlds, m.nu)
        self.position, self.quaternion = torch.zeros(worlds, m.nbody, 3), torch.zeros(worlds, m.nbody, 4)
        self.quaternion[..., 0] = 1.0

    def kinematics(self) -> SimpleNamespace:
        m, n = TASK.compiled, self.worlds
        mocap = torch.zeros(n, m.nmocap, 3), torch.zeros(n, m.nmocap, 4)
        return SimpleNamespace(
            qpos=self.qpos.clone(), mocap=mocap, position=self.position, quaternion=self.quaternion, site=None
        )


class Tracked:
    """An estimate of chosen poses, updated every control step."""

    def __init__(
        self, worlds: int, sensors: SensorErrorsCfg, control_step: float, smoothing: float = SMOOTHING
    ) -> None:
        torch.manual_seed(0)
        self.world, cfg = ChosenPoses(worlds), ObservationCfg(smoothing=smoothing)
        physics: Physics = self.world  # pyright: ignore[reportAssignmentType]
        self.estimate = StateEstimate(TASK, physics, cfg, sensors, control_step)
        self.count, self.grasped = worlds, torch.zeros(worlds, len(TASK.objects), dtype=torch.bool)

    def update(self, started: torch.Tensor | bool = False) -> None:
        mask = torch.zeros(self.count, dtype=torch.bool) | started
        self.estimate.read_encoders(mask)
        self.estimate.track_objects(mask, self.grasped)

    def place(self, k: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the true positions and orientations of an object, to be written to."""
        body = TASK.objects[k]
        return self.world.position[:, body], self.world.quaternion[:, body]

    def found(self, k: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the estimated positions and orientations of an object."""
        if k == FIXED:
            return self.estimate.kinematics.mocap[0][:, 0], self.estimate.kinematics.mocap[1][:, 0]
        start = int(TASK.compiled.jnt_qposadr[TASK.compiled.body_jntadr[TASK.objects[k]]])
        qpos = self.estimate.qpos[:, start : start + 7].float()
        return qpos[:, :3], qpos[:, 3:]

    def errors(self, k: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the errors of position [m] and orientation, as a rotation vector [rad], shape (N, 3) each."""
        (place, turn), (true_place, true_turn) = self.found(k), self.place(k)
        away = multiply_quaternions(turn, invert_quaternion(true_turn))
        away = away * torch.sign(away[:, :1])
        return (place - true_place).clone(), 2 * away[:, 1:]


def turn_about(axis: tuple[float, float, float], angle: float) -> torch.Tensor:
    return rotation_from_vector(angle * torch.tensor(axis))


@pytest.mark.parametrize("step", [0.0, 0.01])
def test_readings_of_the_joints_have_their_deviation_and_step(step):
    m = TASK.compiled
    tracked = Tracked(500, replace(FAULTLESS, encoder_std=0.004, encoder_step=step), 0.05)
    joints = [int(m.joint(name).qposadr[0]) for name in ("turn", "lift", "left", "right")]
    tracked.world.qpos[:, joints] = torch.linspace(0.1, 0.2, 500, dtype=torch.float64)[:, None]
    readings = []
    for k in range(2):
        tracked.update(k == 0)
        readings.append(tracked.estimate.qpos[:, joints].clone())
    errors = torch.stack(readings) - tracked.world.qpos[:, joints]
    assert errors.std(dim=1).flatten().tolist() == pytest.approx([np.sqrt(0.004**2 + step**2 / 12)] * 8, rel=0.15)
    assert errors.mean(dim=1).abs().max() < 0.001
    assert abs(np.corrcoef(errors[0].flatten(), errors[1].flatten())[0, 1]) < 0.1
    if step:
        steps = torch.stack(readings) / step
        torch.testing.assert_close(steps, steps.round(), rtol=0, atol=1e-4)


def test_velocities_of_the_arm_are_differences_of_its_readings():
    sensors, robot = replace(FAULTLESS, encoder_std=0.01, encoder_step=0.001), TASK.robot
    tracked = Tracked(50, sensors, 0.05)
    tracked.update(True)
    assert not tracked.estimate.qvel.any()
    started = torch.arange(50) % 2 == 0
    for mask in (False, started, False):
        before = tracked.estimate.qpos[:, robot.qpos].float()
        tracked.world.qpos[:, robot.qpos] += 0.02
        tracked.update(mask)
        expected = (tracked.estimate.qpos[:, robot.qpos].float() - before) / 0.05
        if mask is not False:
            expected[started] = 0.0
        torch.testing.assert_close(tracked.estimate.qvel[:, robot.dof], expected)
        assert expected[~started].all(dim=1).float().mean() > 0.9
    others = np.setdiff1d(np.arange(TASK.compiled.nv), robot.dof)
    assert not tracked.estimate.qvel[:, others].any()


@pytest.mark.parametrize("rate", [20.0, 90.0])
@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_resting_object_has_the_constant_errors_and_averages_the_others_away(share, rate):
    deviations, updates, control_step, dropout = (0.002, 0.02), 60, 0.05, 0.25
    sensors = SensorErrorsCfg(
        rate=rate, position_std=deviations[0], orientation_std=deviations[1], constant_share=share, dropout=dropout
    )
    tracked = Tracked(400, sensors, control_step)
    for k in range(3):
        place, turn = tracked.place(k)
        place[:], turn[:] = torch.tensor([0.1, -0.2, 0.3]) * k, turn_about((0.6, 0.0, 0.8), 0.7)
    tracked.update(True)
    before = [tracked.errors(k) for k in range(3)]
    for _ in range(updates):
        tracked.update()
    gain = 1 - np.exp(-1 / (rate * SMOOTHING))
    moving = gain / (2 - gain)  # of the variance of white errors, an exponential average leaves this
    frames = (1 - dropout) * updates * control_step * rate
    for k in range(3):
        left = (1 / FIRST_FRAMES, 1 / (FIRST_FRAMES + frames)) if k == FIXED else (moving, moving)
        for first, last, deviation in zip(before[k], tracked.errors(k), deviations, strict=True):
            for error, white in ((first, left[0]), (last, left[1])):
                expected = deviation * np.sqrt(share + (1 - share) * white)
                assert error.std(dim=0).tolist() == pytest.approx([expected] * 3, rel=0.17), k
                assert error.mean(dim=0).abs().max() < 4 * expected / 20, k
            common = float((first * last).mean())
            assert common == pytest.approx(share * deviation**2, rel=0.15, abs=0.03 * deviation**2), k
            if share == 1.0:
                torch.testing.assert_close(last, first, rtol=0, atol=2e-5)


def test_constant_errors_are_sampled_anew_in_a_new_episode():
    sensors = replace(FAULTLESS, position_std=0.002, orientation_std=0.02, constant_share=1.0)
    tracked = Tracked(300, sensors, 0.05)
    tracked.update(True)
    before = tracked.errors(0)
    started = torch.arange(300) < 150
    tracked.update(started)
    for first, last in zip(before, tracked.errors(0), strict=True):
        torch.testing.assert_close(last[~started], first[~started], rtol=0, atol=2e-5)
        assert abs(np.corrcoef(first[started].flatten(), last[started].flatten())[0, 1]) < 0.2
        assert (last[started] != first[started]).any(dim=1).all()


def test_pose_is_known_after_its_latency():
    rate, control_step, jump = 10.0, 0.01, 40
    tracked = Tracked(200, replace(FAULTLESS, rate=rate, latency=(1.0, 2.0)), control_step, smoothing=0.0)
    tracked.update(True)
    shares = []
    for k in range(1, jump + 40):
        if k == jump:
            tracked.place(0)[0][:, 0] += 0.5
            tracked.place(0)[1][:] = turn_about((0.0, 0.0, 1.0), 0.4)
        tracked.update()
        shares.append((tracked.found(0)[0][:, 0] / 0.5).clone())
    known = torch.stack(shares)  # of updates 1, 2, ...
    since = control_step * rate * (torch.arange(1, jump + 40) - jump)  # the jump [frames]
    # Between two updates the object moves from the one place to the other.
    assert not known[since < 1.0 - 2 * control_step * rate].any()
    late = since > 3.0 + control_step * rate
    torch.testing.assert_close(known[late], torch.ones_like(known[late]))
    turn = turn_about((0.0, 0.0, 1.0), 0.4).expand(200, 4)
    torch.testing.assert_close(tracked.found(0)[1], turn, rtol=0, atol=1e-5)
    arrival = since[(known > 0.5).int().argmax(dim=0)]
    # A latency of 1 to 2 frames, and 0 to 1 until the next frame.
    assert float(arrival.mean()) == pytest.approx(2.0, abs=0.12)
    assert float(arrival.std()) == pytest.approx(np.sqrt(2 / 12), rel=0.15)
    assert float(arrival.min()) < 1.4
    assert float(arrival.max()) > 2.6


def test_average_follows_with_its_time_constant():
    rate, control_step = 100.0, 0.02
    tracked = Tracked(3, replace(FAULTLESS, rate=rate, latency=(0.0, 0.0)), control_step)
    tracked.update(True)
    tracked.place(0)[0][:] = 1.0
    for _ in range(20):
        tracked.update()
    frames = 20 * control_step * rate
    lower, upper = (1 - np.exp(-n / (rate * SMOOTHING)) for n in (frames - 2, frames + 1))
    assert (tracked.found(0)[0] > lower).all()
    assert (tracked.found(0)[0] < upper).all()


@pytest.mark.parametrize("dropout", [0.0, 1.0])
def test_grasped_object_is_carried_with_the_hand_without_lag(dropout):
    control_step = 0.05
    tracked = Tracked(20, replace(FAULTLESS, dropout=dropout), control_step, smoothing=0.02)
    tracked.grasped[:, 0] = True
    hand, turn = tracked.world.position[:, HAND], tracked.world.quaternion[:, HAND]
    offset, tilt = torch.tensor([0.02, 0.0, -0.05]).expand(20, 3), turn_about((1.0, 0.0, 0.0), 0.3)

    def put(step: int) -> None:
        """Move the hand, object 1 in it and object 3 beside it."""
        hand[:] = torch.tensor([0.2, -0.1, 0.05]) * control_step * step
        turn[:] = turn_about((0.0, 0.6, 0.8), 0.5 * control_step * step)
        place, orientation = tracked.place(0)
        place[:], orientation[:] = hand + rotate_vectors(turn, offset), multiply_quaternions(turn, tilt.expand(20, 4))
        tracked.place(2)[0][:] = hand

    put(0)
    tracked.update(True)
    for step in range(1, 30):
        put(step)
        tracked.update()
        for error in tracked.errors(0):
            assert error.abs().max() < 1e-4, step
    behind = -tracked.errors(2)[0][:, 0] / 0.2  # [s]
    if dropout:
        torch.testing.assert_close(behind, torch.full((20,), 29 * control_step))
    else:
        assert (behind > 0.9 / 30).all()
        assert (behind < 0.2).all()


def test_grasped_object_that_slips_is_seen_where_it_is():
    tracked = Tracked(20, FAULTLESS, 0.05, smoothing=0.0)
    tracked.grasped[:, 0] = True
    tracked.update(True)
    for step in range(20):
        tracked.world.position[:, HAND, 0] = 0.01 * step
        tracked.place(0)[0][:, 0] = 0.01 * min(step, 9)  # then it stays
        tracked.update()
    # Of the time since a frame alone it is thought to be carried on.
    assert (tracked.errors(0)[0][:, 0] < 0.01 * 3 / (30 * 0.05) + 1e-4).all()
    assert (tracked.errors(0)[0][:, 0] > 0.01 * 1 / (30 * 0.05) - 1e-4).all()


def test_estimate_stays_the_first_where_no_frame_finds_the_object():
    sensors = SensorErrorsCfg(dropout=1.0)
    tracked = Tracked(20, sensors, 0.05)
    tracked.update(True)
    first = [[part.clone() for part in tracked.found(k)] for k in range(3)]
    for k in range(3):
        tracked.place(k)[0][:] += 1.0
    for _ in range(10):
        tracked.update()
    for k in range(3):
        assert not torch.allclose(first[k][0], torch.zeros(20, 3))
        for found, expected in zip(tracked.found(k), first[k], strict=True):
            torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


def test_new_episode_knows_nothing_of_the_one_before_and_is_tracked_alike():
    tracked = Tracked(40, replace(FAULTLESS, rate=10.0, latency=(1.0, 1.5)), 0.05, smoothing=0.0)
    tracked.grasped[:, 2] = True
    started, none = torch.arange(40) % 2 == 0, torch.zeros(40, dtype=torch.bool)
    tracked.update(True)
    for _ in range(60):
        for k in range(3):
            tracked.place(k)[0][:] += 0.02
        tracked.world.position[:, HAND] += 0.02
        tracked.update()
    for k in range(3):
        place, turn = tracked.place(k)
        place[started], turn[started] = torch.tensor([3.0, 2.0, 1.0]), turn_about((0.0, 1.0, 0.0), 0.5)
    tracked.world.position[started, HAND] = -1.0
    stayed = tracked.found(0)[0][~started].clone()
    for step in range(10):
        tracked.update(none if step else started)
        for k in range(3):
            for error in tracked.errors(k):
                assert error[started].abs().max() < 1e-5, (step, k)
        if step == 0:  # in the other worlds no more than one frame has arrived
            assert (tracked.found(0)[0][~started] - stayed).abs().max() < 0.05
    tracked.place(0)[0][:, 0] += 0.5
    for step in range(6):  # after 2.5 frames at most the object is seen in its new place
        if step == 1:
            assert (tracked.errors(0)[0][:, 0] < -0.4).all()
        tracked.update()
    assert tracked.errors(0)[0].abs().max() < 1e-5


def test_orientation_is_the_same_whatever_the_sign_of_its_quaternion():
    found = []
    for flips in (False, True):
        tracked = Tracked(10, FAULTLESS, 0.05)
        tracked.grasped[:, 2] = True
        for step in range(20):
            sign = -1 if flips and step % 3 else 1
            for k in (0, 2):
                tracked.place(k)[1][:] = sign * turn_about((0.6, 0.0, 0.8), 2.0 + 0.05 * step)
            tracked.update(step == 0)
        found.append([tracked.errors(k)[1] for k in (0, 2)])
    for plain, flipped in zip(*found, strict=True):
        assert plain.abs().max() > 0.01
        torch.testing.assert_close(flipped, plain, rtol=0, atol=1e-5)


def test_estimate_goes_on_exactly_from_its_memory():
    sensors = SensorErrorsCfg(dropout=0.3)
    whole, other = (Tracked(10, sensors, 0.05) for _ in range(2))
    rng = torch.Generator().manual_seed(3)
    path = torch.randn(40, 10, TASK.compiled.nbody, 3, generator=rng)
    turns = rotation_from_vector(torch.randn(40, 10, TASK.compiled.nbody, 3, generator=rng))
    joints = torch.randn(40, 10, TASK.compiled.nq, generator=rng)

    def go(tracked: Tracked, steps: range) -> list[torch.Tensor]:
        found = []
        for k in steps:
            tracked.world.position[:], tracked.world.quaternion[:] = path[k], turns[k]
            tracked.world.qpos[:] = joints[k]
            tracked.grasped[:, 0] = k % 7 < 4
            tracked.update(torch.full((10,), k == 0) | ((torch.arange(10) + k) % 13 == 12))
            e = tracked.estimate
            found += [value.clone() for value in (e.qpos, e.qvel, *e.kinematics.mocap)]
        return found

    torch.manual_seed(1)
    go(whole, range(20))
    memory = {name: value.clone() for name, value in whole.estimate.memory.items()}
    assert all(name.startswith("estimated ") for name in memory)
    generator = torch.get_rng_state()
    expected = go(whole, range(20, 40))
    go(other, range(5))
    for name, value in other.estimate.memory.items():
        value.copy_(memory[name])
    torch.set_rng_state(generator)
    for found, value in zip(go(other, range(20, 40)), expected, strict=True):
        assert torch.equal(found, value)


def test_latencies_are_in_order():
    observation = ObservationCfg(sensors=SensorErrorsCfg(latency=(2.0, 1.0)))
    environment = replace(TrainCfg().environment, observation=observation)
    with pytest.raises(TrainError, match="latency is out of bounds; expected a smallest and a largest value"):
        TrainCfg(environment=environment)
