"""Thresholds, counts, resets, logs and saved states of the environment, on states that are chosen exactly."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from made_up_task import (
    SETTINGS,
    ChosenPhysics,
    changed,
    made_up_qpos,
    made_up_states,
    make_environment,
    make_task,
)
from small_insertion import EXACT_STATE

from concent_warp.errors import TrainError
from concent_warp.kernels.contact_pairs import PairTable
from concent_warp.train.environment.environment import TERMS, Environment
from concent_warp.train.environment.state_estimate import FIRST_FRAMES
from concent_warp.train.observation_cfg import ObservationCfg, SensorErrorsCfg
from concent_warp.train.task.task import Task

EXACT = changed(
    dropped=0.125, lost=0.5, success=0.0625, max_position=64.0, max_velocity=32.0, collision="full",
    chain={"tolerance": 0.25, "hold": 1}, episode=60.0,
)  # fmt: skip
"""Thresholds that are exact in single precision."""


def exact_task(**kinds) -> Task:
    """Return a task whose pairs are of block and box at their origins, and are watched like those of the hand."""
    task = make_task(EXACT, target=(0.0, 0.0, 0.0), **kinds)
    shape = task.table.used.shape
    block, box = (np.full(shape, task.compiled.body(name).id) for name in ("block", "box"))
    active = np.broadcast_to([True, False, False], shape)
    zero, points = np.zeros(shape), np.zeros((*shape, 3))
    table = PairTable(block, points, zero, box, points, zero, points, active)
    (held,) = task.events.body_contacts
    events = replace(task.events, body_contacts=(replace(held, b="box"),))
    return replace(task, table=table, robot_slots=active.copy(), events=events)


def at_places(task: Task, places: list[tuple[float, float, float]], cfg=EXACT) -> tuple[Environment, ChosenPhysics]:
    """Return a world for each place, with object 1 put there after the next step and object 2 at the origin."""
    states = made_up_states(task, 1)
    states.mocap[:] = [0, 0, 0, 1, 0, 0, 0]
    states.qpos[:], states.qvel[:] = task.compiled.qpos0, 0.0
    states.stage[:] = task.stage
    environment, physics = make_environment(task, replace(cfg, worlds=len(places)), states)
    qpos = np.tile(task.compiled.qpos0, (len(places), 1))
    qpos[:, :3] = places
    physics.chosen = qpos, np.zeros((len(places), task.compiled.nv))
    return environment, physics


def still(environment: Environment) -> torch.Tensor:
    return torch.zeros(environment.num_envs, environment.num_actions)


def test_a_grasped_object_is_dropped_beyond_its_distance_and_lost_beyond_that_of_the_objects():
    task = exact_task()
    environment, _ = at_places(task, [(x, 0.0, 0.0) for x in (0.0625, 0.125, 0.1875, -0.125, 0.0)])
    environment.step(still(environment))
    assert environment.failure[:, 0].tolist() == [False, False, True, False, False]
    assert not environment.failure[:, 1:].any()
    free = replace(task, robot_slots=np.zeros_like(task.robot_slots))
    environment, _ = at_places(free, [(0.0, y, 0.0) for y in (0.25, 0.5, 0.75, -0.5, -1.0, 0.0)])
    environment.step(still(environment))
    assert environment.failure[:, 0].tolist() == [False, False, True, False, True, False]
    alone = replace(free, objects=free.objects[:1], target_position=None)
    environment, _ = at_places(alone, [(0.0, 0.75, 0.0), (4.0, 0.0, 0.0)])
    environment.step(still(environment))
    assert not environment.failure.any()


def test_objects_are_not_watched_in_a_stage_that_does_not_grasp_them():
    task = exact_task(first=0, last=0)
    assert not task.starts_grasped(0)
    environment, _ = at_places(task, [(0.3, 0.0, 0.0)])
    environment.step(still(environment))
    assert not environment.failure.any()


def test_success_is_a_deviation_below_the_tolerance_on_every_axis():
    task = exact_task()
    places = [
        (0.0, 0.0, 0.0), (0.0625, 0.0, 0.0), (0.0, -0.0625, 0.0), (0.0, 0.0, 0.0625), (0.0615, -0.0615, 0.0615),
        (-0.07, 0.0, 0.0), (0.03, 0.07, 0.03), (0.03, 0.03, -0.07),
    ]  # fmt: skip
    environment, _ = at_places(task, places)
    environment.step(still(environment))
    assert environment.success.tolist() == [True, False, False, False, True, False, False, False]
    by_pairs = replace(task, target_position=None)
    environment, _ = at_places(by_pairs, [*places[:3], (0.0625, 0.0625, 0.0), (0.01, 0.02, 0.03)])
    environment.step(still(environment))
    assert environment.success.tolist() == [True, False, False, False, True]


def test_a_target_is_met_below_the_tolerance():
    task = replace(exact_task(), robot_slots=np.zeros((3, 3), bool))
    environment, _ = at_places(task, [(x, 0.0, 0.0) for x in (0.25, 0.2499, 0.0, 0.3)])
    environment._steps_within[2] = 5
    environment.step(still(environment))
    assert environment._steps_within.tolist() == [0, 1, 6, 0]
    assert environment.reached.tolist() == [2, 3, 3, 2]
    assert environment.stage.tolist() == [2, 2, 2, 2]


def test_states_at_the_bounds_have_diverged():
    task = exact_task()
    environment, physics = at_places(task, [(0.0, 0.0, 0.0)] * 9)
    assert physics.chosen is not None
    qpos, qvel = physics.chosen
    qpos[[0, 1, 2, 3], [15, 14, 0, 16]] = 64.0, -64.0, 100.0, 63.9
    qvel[[4, 5, 6], [3, 15, 15]] = 32.0, -40.0, 31.9
    physics.ctrl[7, 3] = np.nan
    environment.step(still(environment))
    diverged = environment.failure[:, 2].tolist()
    assert diverged == [True, True, True, False, True, True, False, True, False]
    failure = -EXACT.reward.failure * EXACT.reward.lenience
    expected = torch.zeros(6, len(TERMS))
    expected[:, -1] = failure
    torch.testing.assert_close(environment.terms[environment.failure[:, 2]], expected)
    assert not environment.success[environment.failure[:, 2] & (environment.failure[:, 0])].any()


def test_poses_that_are_no_numbers_have_diverged_even_within_the_bounds():
    task = exact_task()
    environment, _ = at_places(task, [(0.0, 0.0, 0.0), (1e11, 0.0, 0.0)], changed(EXACT, max_position=1e12))
    environment.step(still(environment))
    assert environment.failure.tolist() == [[False, False, False], [False, False, True]]


def test_a_severe_collision_counts_once_and_not_in_a_dropped_or_diverged_world():
    cfg = changed(EXACT, collision="vcp")
    environment, _ = at_places(exact_task(), [(0.0, 0.0, 0.0)] * 4, cfg)
    assert environment._severe is not None
    environment.start_from([0] * 4)
    environment.action.zero_()
    environment._apply_action()
    environment._distance.zero_()
    environment._worst.zero_()
    environment._severe[:] = torch.tensor([1, 1, 1, 0])
    environment._distance[1, 0] = 1.0
    environment.physics.qpos[2, 0] = 65.0
    environment._penalty[:] = torch.tensor([-2.0, -3.0, -4.0, -5.0])
    environment._evaluate_step()
    failed = [[False, True, False], [True, False, False], [False, False, True], [False, False, False]]
    assert environment.failure.tolist() == failed
    assert environment.done.tolist() == [True, True, True, False]
    assert not environment.time_out.any()
    vcp = environment.terms[:, TERMS.index("vcp")]
    torch.testing.assert_close(vcp, 0.9 * 0.3 * torch.tensor([-2.0, -3.0, 0.0, -5.0]))
    torch.testing.assert_close(environment.terms[:, -1], -3.0 * 0.3 * torch.tensor([1.0, 1.0, 1.0, 0.0]))


@pytest.mark.parametrize(("seconds", "steps"), [(0.001, 1), (0.06, 1), (0.1, 2), (0.11, 2), (0.14, 2), (0.17, 3)])
def test_durations_are_rounded_to_control_steps_and_at_least_one(seconds, steps):
    task = exact_task()
    environment, _ = at_places(task, [(0.2, 0.0, 0.0)], changed(EXACT, episode=seconds, dropped=1.0))
    assert environment.control_step == pytest.approx(0.06)
    assert environment.max_episode_length == steps
    for k in range(steps):
        _, _, done, extras = environment.step(still(environment))
        assert done.tolist() == extras["time_outs"].tolist() == [k == steps - 1]
    rest = changed(EXACT, chain={"rest": seconds})
    environment, physics = at_places(task, [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0)], rest)
    for k in range(steps):
        assert environment.max_episode_length == 1000
        _, _, done, extras = environment.step(still(environment))
        assert done.tolist() == [k == steps - 1, False]
        assert not extras["time_outs"].any()  # a task that is done has nothing beyond its end
    assert physics.qpos.shape[0] == 2


def test_rest_is_counted_anew_when_the_object_leaves_and_not_in_a_single_stage():
    cfg = changed(EXACT, chain={"rest": 0.12})
    environment, physics = at_places(exact_task(), [(0.0, 0.0, 0.0)], cfg)
    assert physics.chosen is not None
    for x, done in ((0.0, False), (0.1, False), (0.0, False), (0.0, True)):
        physics.chosen[0][:, 0] = x
        assert environment.step(still(environment))[2].tolist() == [done]
    single = exact_task(first=2)
    environment, _ = at_places(single, [(0.0, 0.0, 0.0)], cfg)
    for _ in range(4):
        assert not environment.step(still(environment))[2].any()


def test_episodes_start_from_all_states_alike_and_keep_what_runs():
    task = exact_task()
    states = made_up_states(task, 4)
    environment, physics = make_environment(task, replace(EXACT, worlds=60), states)
    torch.manual_seed(0)
    physics.warmstart[:] = 7.0
    before = physics.qpos.clone()
    counters = (environment._steps_within, environment._steps_at_rest, environment.episode_length_buf)
    for counter in (*counters, environment._return, environment._stages_met):
        counter[:] = 9
    mask = torch.arange(60) % 6 > 0
    environment._start(mask)
    found = np.abs(physics.qpos.numpy()[:, None] - states.qpos[None]).max(axis=2)
    rows = found.argmin(axis=1)
    assert (found[mask.numpy()].min(axis=1) < 1e-6).all()
    counts = np.bincount(rows[mask.numpy()], minlength=4)
    assert (counts > 5).all(), counts
    assert torch.equal(physics.qpos[~mask], before[~mask])
    assert (physics.warmstart[mask] == 0).all()
    assert (physics.warmstart[~mask] == 7).all()
    for counter in (*counters, environment._return):
        assert (counter[mask] == 0).all()
        assert (counter[~mask] == 9).all()
    assert environment._stages_met[mask].tolist() == states.stage[rows[mask.numpy()]].tolist()
    assert (environment._stages_met[~mask] == 9).all()
    assert environment._from_start[mask].tolist() == states.begins[rows[mask.numpy()]].tolist()


def test_commands_begin_anew_in_the_worlds_that_begin_anew():
    environment, physics = at_places(exact_task(), [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 0.0, 0.0)])
    masks = []
    physics.reset_commands = lambda mask: masks.append(mask.tolist())
    environment.step(still(environment))
    assert masks == [[False, True, False]]
    environment.start_from([0, 0, 0])
    assert masks[1:] == [[True, True, True]]


def test_reset_spreads_the_elapsed_times_and_forgets_the_past():
    task = exact_task()
    environment, physics = make_environment(task, replace(EXACT, worlds=300, episode=0.3), made_up_states(task))
    assert not environment.episode_length_buf.any()
    environment._log.sums += 3
    environment._success_average += 0.5
    environment._divergence.happened.fill_(True)
    environment._return += 1
    torch.manual_seed(0)
    environment.reset()
    counts = np.bincount(environment.episode_length_buf.numpy(), minlength=5)
    assert len(counts) == 5
    assert counts.min() > 30
    assert not environment._return.any()
    assert float(environment._success_average) == 0.0
    assert environment.diverged_state() is None
    assert not any(environment.read_log().values())
    physics.update_poses()
    shown = environment.observation[:, environment.layout.columns("object 1")][:, :3]
    torch.testing.assert_close(shown, physics.qpos[:, :3].float())


def test_first_divergence_is_kept_with_the_state_before_it():
    task = exact_task()
    environment, physics = at_places(task, [(0.0, 0.0, 0.0)] * 3)
    assert environment.diverged_state() is None
    environment.step(still(environment))
    assert environment.diverged_state() is None
    assert physics.chosen is not None
    rng = np.random.default_rng(0)
    for values in (physics.qpos, physics.qvel, physics.ctrl):
        values[:] = torch.as_tensor(rng.uniform(-0.01, 0.01, values.shape))
    physics.mocap[0][:], physics.mocap[1][:] = torch.rand(3, 1, 3), torch.tensor([0.0, 0.6, 0.0, 0.8])
    state = [v[1].clone() for v in (physics.qpos, physics.qvel, physics.ctrl, *physics.mocap)]
    physics.chosen[0][1:, 0] = 70.0
    environment.step(torch.ones(3, environment.num_actions))
    for _ in range(2):
        found = environment.diverged_state()
        assert found is not None
        assert list(found) == ["qpos", "qvel", "ctrl", "mocap_pos", "mocap_quat", "world"]
        assert found["world"] == 1
        assert found["world"].shape == ()
        for value, (name, kept) in zip(state, found.items(), strict=False):
            np.testing.assert_allclose(kept, value.numpy(), atol=1e-12, err_msg=name)
        assert found["mocap_pos"].shape == (1, 3)
        physics.chosen[0][0, 0] = 70.0
        environment.step(still(environment))  # another one changes nothing


def test_log_is_of_the_steps_since_the_last_one_and_of_all_ranks():
    task = exact_task()
    environment, physics = at_places(task, [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.05, 0.0, 0.0), (0.1, 0.0, 0.0)])
    assert physics.chosen is not None
    environment._from_start[:] = torch.tensor([True, True, False, False])
    environment.step(still(environment))
    # One episode has ended: lost, after one step, and it began before the first stage.
    total = environment._log.sums.clone()
    log = environment.read_log(lambda sums: 3 * sums)
    assert log["steps"] == 12
    assert log["episodes"] == log["chains"] == log["diverged worlds"] + 3 == 3
    assert log["length"] == 1.0
    assert log["dropped"] == 1.0
    assert log["success"] == log["success of all"] == log["time outs"] == log["severe"] == log["diverged"] == 0.0
    assert log["met pick"] == log["met align"] == 1.0
    assert log["met insert"] == 0.0
    reach = float(total[TERMS.index("reach")])
    assert log["reach"] == pytest.approx(reach / 4)
    assert not any(environment.read_log().values())
    environment._log.sums[:] = 0.0
    environment._log.sums[environment._log.names.index("episodes")] = 1.0
    environment._log.sums[environment._log.names.index("return")] = 5.0
    assert environment.read_log()["return"] == 5.0
    single = make_task(EXACT, first=2)
    log = make_environment(single, EXACT)[0].read_log()
    assert "success of all" not in log
    assert not [name for name in log if name.startswith(("met", "chain"))]


def test_success_rate_is_an_average_over_as_many_episodes_as_worlds():
    task = exact_task()
    places = [(0.0, 0.0, 0.0)] * 3 + [(0.1, 0.0, 0.0)]
    environment, physics = at_places(task, places, changed(EXACT, episode=0.12, chain={"rest": 60.0}))
    environment._success_average.fill_(0.25)
    environment.step(still(environment))
    assert float(environment._success_average) == pytest.approx(0.25)  # no episode has ended
    environment.step(still(environment))
    share = 0.75 + (0.25 - 0.75) * np.exp(-1.0)
    assert float(environment._success_average) == pytest.approx(share)
    assert physics.chosen is not None
    environment.episode_length_buf[:] = 0
    environment.episode_length_buf[0] = 1
    environment.step(still(environment))
    assert float(environment._success_average) == pytest.approx(1 + (share - 1) * np.exp(-0.25))


PERTURBED = changed(EXACT, randomisation={"perturbation": (2.0, 0.5), "perturbation_share": 0.4})


def test_perturbations_are_of_their_deviations_on_grasped_objects_in_training():
    task = make_task(PERTURBED)
    environment, physics = make_environment(task, replace(PERTURBED, worlds=50), made_up_states(task))
    environment._perturbing.fill_(1)
    environment.stage[:] = torch.arange(50) % 3
    torch.manual_seed(4)
    environment._apply_action()
    torch.manual_seed(4)
    hit = (torch.rand(50) < 0.4) & (environment.stage > 0)
    expected = torch.randn(50, 6) * torch.tensor([2.0, 2.0, 2.0, 0.5, 0.5, 0.5]) * hit[:, None]
    wrench = physics.wrench.clone()
    torch.testing.assert_close(wrench[:, task.objects[0]], expected)
    assert 5 < int(hit.sum()) < 30
    wrench[:, task.objects[0]] = 0
    assert not wrench.any()
    environment.start_from([0] * 50)
    environment.stage[:] = 1
    environment._apply_action()
    assert not physics.wrench.any()
    environment.reset()
    environment.stage[:] = torch.arange(50) % 3
    torch.manual_seed(4)
    environment._apply_action()
    torch.testing.assert_close(physics.wrench[:, task.objects[0]], expected)


@pytest.mark.parametrize("deviations", [(2.0, 0.0), (0.0, 0.5), (0.0, 0.0)])
def test_forces_and_torques_are_perturbed_each_by_itself(deviations):
    cfg = changed(EXACT, randomisation={"perturbation": deviations, "perturbation_share": 1.0})
    task = make_task(cfg)
    environment, physics = make_environment(task, cfg, made_up_states(task))
    environment._perturbing.fill_(1)
    environment.stage[:] = 1
    environment._frames[1, 0] = 1  # as if the tool were on the first body
    environment._apply_action()
    wrench = physics.wrench[:, task.objects[0]]
    assert wrench[:, :3].any().item() == (deviations[0] > 0)
    assert wrench[:, 3:].any().item() == (deviations[1] > 0)


def test_an_action_is_perturbed_where_a_uniform_number_is_below_the_share(monkeypatch):
    task = make_task(PERTURBED)
    environment, physics = make_environment(task, replace(PERTURBED, worlds=3), made_up_states(task))
    environment._perturbing.fill_(1)
    environment.stage[:] = 1
    share = torch.tensor(0.4)
    monkeypatch.setattr(torch, "rand", lambda *_, **__: torch.stack([share, share - 1e-6, share + 1e-6]))
    environment._apply_action()
    assert physics.wrench[:, task.objects[0]].any(dim=1).tolist() == [False, True, False]


def test_any_flag_of_dropped_contacts_is_an_overflow():
    environment, physics = at_places(exact_task(), [(0.0, 0.0, 0.0)] * 4)
    physics.dropping = -(2**31) + 2
    physics.flags = torch.tensor([-(2**31), 2, 1, 0], dtype=torch.int32)
    environment.step(still(environment))
    assert environment.read_log()["overflow"] == 0.5
    assert not physics.overflow.any()


def test_sensor_errors_are_of_their_deviations_on_what_is_measured_alone():
    task, count = make_task(SETTINGS), 300
    sensors = SensorErrorsCfg(encoder_std=0.001, encoder_step=0.0, position_std=0.02, orientation_std=0.0, rate=20.0)
    states = made_up_states(task, 1)
    torch.manual_seed(0)
    plain, sensed = (
        make_environment(task, changed(SETTINGS, worlds=count, observation=observation), states)[0]
        for observation in ({}, {"sensors": sensors, "smoothing": 0.1})
    )
    assert list(plain.get_observations().keys()) == ["policy"]
    assert torch.equal(sensed.get_observations()["truth"], plain.observation)
    away = sensed.get_observations()["policy"] - plain.observation
    gain = 1 - np.exp(-1 / (20.0 * 0.1))
    # At the start an estimate has the errors that averaging leaves: of free objects those of a moving average, of the
    # fixed one those of the mean of its frames so far.
    left = {"object 1": gain / (2 - gain), "object 2": 1 / FIRST_FRAMES, "object 3": gain / (2 - gain)}
    for name, share in left.items():
        columns = sensed.layout.columns(name)
        expected = 0.02 * np.sqrt(0.25 + 0.75 * share)
        shift = away[:, columns.start : columns.start + 3]
        assert shift.std(dim=0).tolist() == pytest.approx([expected] * 3, rel=0.15), name
        assert shift.mean(dim=0).abs().max() < 4 * expected / np.sqrt(count), name
        assert not away[:, columns.start + 3 : columns.stop].any(), name
    lead = away[:, sensed.layout.columns("command leads")] * torch.as_tensor(task.robot.lead)
    assert lead.std(dim=0).tolist() == pytest.approx([0.001] * 2, rel=0.15)
    assert sensed.layout.columns("joint velocities").stop == sensed.layout.columns("command leads").start
    velocity = sensed.get_observations()["policy"][:, sensed.layout.columns("joint velocities")]
    assert not velocity.any()
    assert not away[:, sensed.layout.columns("gripper command")].any()
    assert 0 < float(away[:, sensed.layout.columns("end effector")].abs().max()) < 0.01
    used = torch.as_tensor(task.table.used[states.stage[0]])
    slots = away[:, sensed.layout.base :].reshape(count, len(used), -1)
    assert not slots[:, ~used].any()
    assert not slots[:, used, 0].any()
    assert slots[:, used, 1:10].ne(0).float().mean(dim=0).min() > 0.95


def test_parts_in_their_order_are_a_step():
    task, rng = make_task(SETTINGS), np.random.default_rng(0)
    pair = [make_environment(task, SETTINGS, made_up_states(task)) for _ in range(2)]
    qpos = made_up_qpos(task, rng, SETTINGS.worlds)
    action = torch.as_tensor(rng.uniform(-1, 1, (SETTINGS.worlds, 3)), dtype=torch.float32)
    for _, physics in pair:
        physics.chosen = qpos, np.ones((len(qpos), task.compiled.nv))
    torch.manual_seed(0)
    shown = pair[0][0].step(action)[0]["policy"]
    other = pair[1][0]
    torch.manual_seed(0)
    other.action.copy_(action)
    parts = other.parts()
    assert len(parts) == 6
    for part in parts:
        part()
    torch.testing.assert_close(other.observation, shown, rtol=0, atol=0)
    torch.testing.assert_close(other.reward, pair[0][0].reward, rtol=0, atol=0)


@pytest.mark.parametrize("observation", [EXACT_STATE, ObservationCfg(history=2)])
def test_state_comes_back_and_one_that_lacks_a_part_or_is_of_another_shape_is_refused(observation):
    cfg = replace(SETTINGS, observation=observation)
    task, rng = make_task(cfg), np.random.default_rng(0)
    environment, physics = make_environment(task, cfg, made_up_states(task))
    for _ in range(3):
        physics.chosen = made_up_qpos(task, rng, SETTINGS.worlds), rng.normal(size=(SETTINGS.worlds, task.compiled.nv))
        environment.step(torch.ones(SETTINGS.worlds, 3))
    state, shown = environment.state(), environment.get_observations()
    buffers = environment._state()
    names = {
        "qpos", "qvel", "ctrl", "warmstart", "mocap position", "mocap quaternion", "length", "return", "stage",
        "from start", "stages met", "steps within", "steps at rest", "success average", "history", "stuck qpos",
        "stuck qvel", "stuck ctrl", "stuck mocap position", "stuck mocap quaternion", "stuck stage", "stuck stored",
        "stuck best distance", "stuck waited", "stuck of stage",
    }  # fmt: skip
    estimated = {
        "past position", "past orientation", "past hand", "past turn", "position", "orientation", "constant", "seen",
        "read", "clock", "newest", "latency", "phase", "qpos", "qvel", "mocap position", "mocap orientation",
    }  # fmt: skip
    assert set(state) == names | ({f"estimated {name}" for name in estimated} if environment.estimate else set())
    for name, value in buffers.items():
        assert value.data_ptr() != state[name].data_ptr()
        value.zero_()
    environment.restore(state)
    for name, value in buffers.items():
        torch.testing.assert_close(value, state[name], rtol=0, atol=0)
    assert set(environment.get_observations().keys()) == set(shown.keys())
    for name, value in environment.get_observations().items():
        torch.testing.assert_close(value, shown[name], rtol=0, atol=0)
    with pytest.raises(TrainError, match="more"):
        environment.restore({**state, "more": torch.zeros(1)})
    del state["stage"], state["ctrl"]
    with pytest.raises(TrainError, match=r"lacks a part.*\['ctrl', 'stage'\]"):
        environment.restore(state)
    with pytest.raises(TrainError, match="checkpoint"):
        environment.restore({**environment.state(), "stage": torch.zeros(3)})


def test_environment_tells_its_sizes_and_gives_copies_of_its_observation():
    task = make_task(SETTINGS)
    environment, physics = make_environment(task, SETTINGS, made_up_states(task))
    assert (environment.num_envs, environment.num_actions, environment.device) == (10, 3, "cpu")
    assert environment.buffers is None
    physics.buffers = (3, 4)
    assert environment.buffers == (3, 4)
    assert environment.cfg == asdict(SETTINGS)
    observation = environment.get_observations()
    assert observation.batch_size == (10,)
    environment.observation.zero_()
    assert observation["policy"].any()
    assert environment.terms.shape == (10, len(TERMS))
    assert environment._reach.shape == (10, 2)


@pytest.mark.parametrize(("capture", "graphs"), [("none", False), ("physics", True), ("step", True)])
def test_kernels_are_captured_unless_nothing_is(capture, graphs):
    task = make_task(SETTINGS)
    environment, _ = make_environment(task, changed(SETTINGS, capture=capture), made_up_states(task))
    assert (environment._measured._graph is not None, environment._paired._graph is not None) == (graphs, graphs)


def test_penalty_without_virtual_collisions_is_none():
    for cfg, virtual in ((SETTINGS, True), (changed(SETTINGS, collision="full"), False)):
        environment, _ = make_environment(make_task(cfg), cfg)
        assert (environment._virtual is not None) == virtual
        assert (environment._severe is not None) == virtual
        assert (environment._penalty is not environment._none) == virtual
