"""Bookkeeping of the vectorised environment."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from small_insertion import SETTINGS

from concent_warp.errors import TrainError
from concent_warp.train.cfg import TrainCfg
from concent_warp.train.environment.environment import TERMS, Environment
from concent_warp.train.environment.graphs import _compiled_or_plain
from concent_warp.train.environment.physics import WarpPhysics
from concent_warp.train.environment.randomisation import sample_model_fields
from concent_warp.train.environment.worlds import _make_physics, make_environment, simulation_steps


def still(environment: Environment) -> torch.Tensor:
    return torch.zeros(environment.num_envs, environment.num_actions)


def start(environment: Environment) -> None:
    environment.start_from(list(range(environment.num_envs)))
    environment.read_log()


def test_episode_that_runs_its_time_is_a_time_out_and_no_failure(environment):
    start(environment)
    for _ in range(environment.max_episode_length - 1):
        _, _, done, extras = environment.step(still(environment))
        assert not done.any()
        assert not extras["time_outs"].any()
    _, _, done, extras = environment.step(still(environment))
    assert done.all()
    assert extras["time_outs"].all()
    assert not environment.failure.any()
    log = environment.read_log()
    assert log["time outs"] == 1.0
    assert log["length"] == environment.max_episode_length
    assert (environment.episode_length_buf == 0).all()


def test_letting_go_is_a_failure_and_no_time_out(task, states):
    strict = replace(SETTINGS, reward=replace(SETTINGS.reward, lenience=1.0))
    environment = make_environment(task, strict, states, device="cpu")
    start(environment)
    opening = still(environment)
    opening[:, -1] = 1.0
    environment.physics.ctrl[:, -1] = 0.03
    ended = torch.zeros(environment.num_envs, dtype=torch.bool)
    for _ in range(environment.max_episode_length - 1):
        _, reward, done, extras = environment.step(opening)
        assert not extras["time_outs"].any()
        fallen = environment.failure[:, 0]
        assert (done >= fallen).all()
        expected = -strict.reward.failure * done.float()
        torch.testing.assert_close(environment.terms[:, TERMS.index("failure")], expected)
        torch.testing.assert_close(reward, strict.reward.scale * environment.terms.sum(dim=1))
        ended |= fallen
        environment.physics.ctrl[:, -1] = 0.03
    # Blocks low in the hole have nowhere to fall.
    assert ended.float().mean() > 0.5


def test_world_that_diverges_is_reset_counted_and_kept_apart(environment):
    start(environment)
    before = environment.physics.qvel.clone()
    environment.physics.qvel[3, 0] = 1e9
    _, reward, done, extras = environment.step(still(environment))
    assert done.nonzero().ravel().tolist() == [3]
    assert not extras["time_outs"].any()
    assert environment.failure[3].tolist() == [False, False, True]
    assert torch.isfinite(reward).all()
    assert torch.isfinite(environment.observation).all()
    assert environment.read_log()["diverged worlds"] == 1
    diverged = environment.diverged_state()
    assert diverged is not None
    assert diverged["qvel"][0] == pytest.approx(1e9)
    np.testing.assert_allclose(diverged["qvel"][1:], before[3, 1:], atol=1e-6)


def test_ended_worlds_start_from_initial_states_and_show_them(environment, states):
    start(environment)
    environment.episode_length_buf[::2] = environment.max_episode_length
    observation, _, done, _ = environment.step(still(environment))
    assert done[::2].all()
    assert not done[1::2].any()
    qpos = environment.physics.qpos.numpy()
    nearest = np.abs(qpos[:, None] - states.qpos[None]).max(axis=2).min(axis=1)
    assert nearest[::2].max() < 1e-6
    shown = observation["policy"][:, environment.layout.columns("object 1")][:, :3]
    np.testing.assert_allclose(shown[::2], qpos[::2, :3], atol=1e-6)


def test_returned_observations_are_copies(environment):
    observation = environment.get_observations()["policy"]
    kept = observation.clone()
    environment.step(torch.ones(environment.num_envs, environment.num_actions))
    torch.testing.assert_close(observation, kept, rtol=0, atol=0)


def test_actions_step_commands_within_range_and_lead(environment, task):
    start(environment)
    before = environment.physics.ctrl.clone()
    environment.step(torch.full((environment.num_envs, environment.num_actions), 0.5))
    moved = environment.physics.ctrl[:, :3] - before[:, :3]
    np.testing.assert_allclose(moved, 0.5 * 0.004, atol=1e-6)
    for _ in range(20):
        at = environment.physics.qpos[:, task.robot.qpos].float()
        done = environment.step(torch.full((environment.num_envs, environment.num_actions), -7.0))[2]
        ahead = (environment.physics.ctrl[:, :3] - at).abs()[~done]
        assert (ahead <= 0.015 + 1e-6).all()
        assert (environment.physics.ctrl[:, 3] >= -0.01 - 1e-7).all()


def test_success_is_block_in_its_demonstrated_place(environment, task):
    start(environment)
    block = environment.physics.qpos[:, :3]
    box = task.compiled.body("box").pos
    block[:] = torch.as_tensor(box + task.target_position)
    block[1::2, 2] += 0.006
    environment.physics.update_poses()
    off = (environment.relative_position() - torch.as_tensor(task.target_position)).abs().max(dim=1).values
    assert (off[::2] < 1e-6).all()
    assert (off[1::2] > 0.005).all()
    environment.physics.qvel.zero_()
    environment.step(still(environment))
    assert environment.success[::2].float().mean() > environment.success[1::2].float().mean()


def test_leads_are_penalised_relative_to_the_largest(task, states):
    cfg = replace(SETTINGS, worlds=4, reward=replace(SETTINGS.reward, press=0.3))
    environment = make_environment(task, cfg, states, device="cpu")
    start(environment)
    environment.step(torch.full((4, environment.num_actions), 0.7))
    p, robot = environment.physics, task.robot
    ahead = (p.ctrl[:, robot.actuator] - p.qpos[:, robot.qpos]) / torch.as_tensor(robot.lead)
    assert ahead.abs().max() > 0.03
    np.testing.assert_allclose(environment.terms[:, TERMS.index("press")], -0.3 * ahead.square().sum(dim=1), rtol=1e-4)


def test_penalties_become_strict_with_success(task, states):
    count = len(states.qpos)
    cfg = replace(SETTINGS, worlds=count, reward=replace(SETTINGS.reward, failure=7.0, lenience=0.25))
    environment = make_environment(task, cfg, states, device="cpu")
    environment.reset()

    def finish(rows: list[int]) -> None:
        """End an episode from each of these states at once, but one that fails for its block was taken away."""
        environment.start_from(rows)
        environment.physics.qpos[3, 2] += 0.3
        environment.episode_length_buf[:] = environment.max_episode_length
        environment.step(still(environment))
        assert environment.failure[3, 0]

    finish(list(range(count)))
    assert environment.terms[3, TERMS.index("failure")] == pytest.approx(-0.25 * 7.0)
    inserted = (environment.success & ~environment.failure.any(dim=1)).nonzero().ravel().tolist()
    for _ in range(10):
        finish((inserted * count)[:count])
    share = float((environment.success & ~environment.failure.any(dim=1)).float().mean())
    assert share > 0.9
    expected = -7.0 * (0.25 + 0.75 * share**2)
    assert environment.terms[3, TERMS.index("failure")] == pytest.approx(expected, rel=0.02)


def test_saved_state_is_gone_on_with_exactly(environment):
    start(environment)
    environment.step(0.3 * torch.ones(environment.num_envs, environment.num_actions))
    state = environment.state()
    first = environment.step(still(environment))[0]["policy"]
    environment.step(still(environment))
    environment.restore(state)
    again = environment.step(still(environment))[0]["policy"]
    torch.testing.assert_close(first, again, rtol=0, atol=0)


def test_both_simulators_give_the_same_steps(task, states):
    cfg = replace(SETTINGS, worlds=4, decimation=2)
    found = []
    for engine in ("mujoco", "warp"):
        torch.manual_seed(0)
        environment = make_environment(task, replace(cfg, engine=engine), states, device="cpu")
        start(environment)
        actions = 0.2 * torch.ones(4, environment.num_actions)
        for _ in range(4):
            environment.step(actions)
        observation, reward, _, _ = environment.step(actions)
        found.append((observation["policy"], reward))
    torch.testing.assert_close(found[0][0], found[1][0], rtol=0, atol=2e-3)
    torch.testing.assert_close(found[0][1], found[1][1], rtol=0, atol=2e-3)


def test_randomised_fields_differ_between_worlds_and_are_used(task):
    cfg = replace(SETTINGS.randomisation, friction=(0.5, 1.5), grip=(2.0, 3.0), stiffness=(0.8, 1.2), mass=(0.5, 2.0))
    fields = sample_model_fields(task, 4, cfg, 0)
    m = task.compiled
    ratio = fields["geom_friction"][:, :, 0] / m.geom_friction[:, 0]
    robot = [m.body(name).id for name in ("rail", "palm", "left_finger", "right_finger")]
    held = np.isin(m.geom_bodyid, robot)
    for part, (low, high) in ((ratio[:, ~held], (0.5, 1.5)), (ratio[:, held], (2.0, 3.0))):
        assert ((part > low) & (part < high)).all()
        assert len(np.unique(part[:, 0].round(9))) == 4
        np.testing.assert_allclose(part, part[:, :1] * np.ones_like(part))
    heavier = fields["body_mass"] / np.where(m.body_mass > 0, m.body_mass, 1.0)
    assert len(np.unique(heavier[:, m.body("block").id])) == 4
    np.testing.assert_array_equal(fields["body_mass"][:, robot], np.tile(m.body_mass[robot], (4, 1)))
    np.testing.assert_allclose(
        fields["body_inertia"][:, m.body("block").id, 0], m.body("block").inertia[0] * heavier[:, m.body("block").id]
    )
    gain, bias = fields["actuator_gainprm"][..., 0], fields["actuator_biasprm"][..., 1]
    np.testing.assert_allclose(gain, -bias)
    physics = _make_physics(task, replace(SETTINGS, worlds=4, engine="warp", randomisation=cfg), device="cpu")
    assert isinstance(physics, WarpPhysics)
    start_qpos = physics.qpos.clone()
    physics.ctrl[:, :3] = 0.05
    physics.advance()
    moved = (physics.qpos - start_qpos)[:, task.robot.qpos[0]]
    assert len(torch.unique(moved)) == 4


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_sampled_joint_friction_holds_the_arm(task, engine):
    cfg = replace(SETTINGS.randomisation, joint_friction=(50.0, 60.0))
    moved = []
    for randomisation in (SETTINGS.randomisation, cfg):
        settings = replace(SETTINGS, worlds=2, engine=engine, randomisation=randomisation)
        physics = _make_physics(task, settings, device="cpu")
        physics.qpos[:] = torch.as_tensor(task.replay.qpos[0]).to(physics.qpos.dtype)
        physics.ctrl[:] = torch.as_tensor(task.replay.ctrl[0], dtype=torch.float32)
        before = physics.qpos.clone()
        physics.ctrl[:, 0] += 0.015  # 45 N at first, less than the friction
        physics.advance()
        moved.append(float((physics.qpos - before)[0, task.robot.qpos[0]]))
    assert moved[0] > 1e-3
    assert abs(moved[1]) < 0.2 * moved[0]


def test_collidable_spheres_are_those_of_the_events(task):
    spheres = [g for g in range(task.compiled.ngeom) if task.compiled.geom_type[g] == mujoco.mjtGeom.mjGEOM_SPHERE]
    touched = {e.name for e in task.events.entities if e.sphere is not None}
    assert {task.compiled.geom(g).name for g in spheres} == touched
    assert 0 < len(touched) < len(task.collidable)


def test_solver_stops_at_the_iterations_that_are_asked_for(task):
    limited = _make_physics(task, replace(SETTINGS, worlds=1, solver_iterations=3, ls_iterations=7), device="cpu")
    assert (limited.model.opt.iterations, limited.model.opt.ls_iterations) == (3, 7)
    assert task.compiled.opt.iterations != 3
    plain = _make_physics(task, replace(SETTINGS, worlds=1), device="cpu")
    assert plain.model.opt.iterations == task.compiled.opt.iterations


@pytest.mark.gpu
def test_fused_step_is_that_of_single_operations(task, states):
    settings = replace(SETTINGS, engine="warp", worlds=40)
    pair = [make_environment(task, replace(settings, fuse=fuse), states, device="cuda:0") for fuse in (False, True)]
    for one in pair:
        start(one)
    generator = torch.Generator("cuda").manual_seed(0)
    for _ in range(5):
        actions = torch.empty(40, pair[0].num_actions, device="cuda").uniform_(-0.3, 0.3, generator=generator)
        (seen, reward, done, _), (fused, fused_reward, fused_done, _) = (one.step(actions) for one in pair)
        if done.any():  # new states are drawn, and not the same
            break
        torch.testing.assert_close(fused["policy"], seen["policy"], atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(fused_reward, reward, atol=1e-4, rtol=1e-4)
        assert (fused_done == done).all()


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_longer_steps_and_pyramids_keep_the_control_period_and_follow_the_same_commands(task, states, engine):
    fine = replace(SETTINGS, worlds=4, engine=engine)
    coarse = replace(fine, stride=2, cone="pyramidal")
    found = []
    for cfg in (fine, coarse):
        environment = make_environment(task, cfg, states, device="cpu")
        assert environment.control_step == pytest.approx(0.05)
        start(environment)
        torch.manual_seed(1)
        for _ in range(4):
            environment.step(0.3 * torch.randn(environment.num_envs, environment.num_actions))
        found.append(environment.physics.qpos[:, task.robot.qpos].clone())
    # Drives answer a little otherwise in longer steps.
    torch.testing.assert_close(found[0], found[1], atol=1e-3, rtol=0)
    assert not torch.equal(found[0], found[1])


def test_steps_are_by_default_as_long_as_the_stiffest_contact_allows():
    xml = """<mujoco><option timestep="{step}"/><worldbody>
    <body><freejoint/><geom size="0.1" solref="{constant} 1"/><geom size="0.2" solref="0.04 1"/>
    <geom size="0.3" solref="0.001 1" contype="0" conaffinity="0"/><geom size="0.4" solref="-1e4 -100"/></body>
    </worldbody></mujoco>"""

    def steps(step: float, constant: float, stride: int | None = None) -> int:
        m = mujoco.MjModel.from_xml_string(xml.format(step=step, constant=constant))
        return simulation_steps(m, replace(SETTINGS, decimation=12, stride=stride))

    assert [steps(0.001, constant) for constant in (0.001, 0.002, 0.004, 0.0079, 0.008, 0.011, 0.02, 0.04)] == [
        12, 12, 6, 4, 3, 3, 2, 1,
    ]  # fmt: skip
    assert steps(0.005, 0.02) == 6
    assert steps(0.001, 0.02, stride=3) == 4


def test_operations_that_no_compiler_fuses_are_carried_out_one_by_one():
    total = torch.zeros(3)

    def part() -> None:
        total.add_(1.0)
        if total.sum().item() > 100:  # what a graph cannot hold
            total.zero_()

    with pytest.warns(UserWarning, match="not fused"):
        left = _compiled_or_plain(part)
    assert left is part
    left()
    assert (total > 0).all()


def test_stride_that_leaves_part_of_an_action_is_refused():
    with pytest.raises(TrainError, match="expected a divisor of the decimation, 10, found stride 4"):
        TrainCfg(environment=replace(SETTINGS, stride=4))
