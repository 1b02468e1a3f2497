"""Stages one after the other, and objects that stand elsewhere in each world."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from small_insertion import CHAIN, HOLE, SETTINGS, make_task

from concent_warp.errors import TrainError
from concent_warp.train.cfg import TrainCfg
from concent_warp.train.environment.environment import TERMS, Environment
from concent_warp.train.environment.worlds import _make_physics, make_environment
from concent_warp.train.resets.sample import ResetStates, sample_reset_states
from concent_warp.train.task.movable_fixtures import with_movable_fixtures
from concent_warp.train.task.stages import _worst_distance
from concent_warp.train.task.task import Task
from concent_warp.train.trials.evaluate import run_episodes

WORLDS = 6


@pytest.fixture(scope="module")
def chain() -> Task:
    return make_task(CHAIN)


@pytest.fixture(scope="module")
def drawn(chain) -> ResetStates:
    return sample_reset_states(chain, CHAIN.reset, 0, count=160)


@pytest.fixture
def as_shown(chain) -> Environment:
    """Return worlds that all start where the demonstration does."""
    cfg = replace(CHAIN, worlds=2, reset=replace(CHAIN.reset, free=1.0, place=(0.0, 0.0)))
    return make_environment(chain, cfg, sample_reset_states(chain, cfg.reset, 0, count=2), device="cpu")


def as_demonstrated(environment: Environment, k: int) -> torch.Tensor:
    """Command as in step k of the demonstration, and return the action that leaves it so."""
    replay, period = environment.task.replay, CHAIN.decimation
    environment.physics.ctrl[:] = torch.as_tensor(replay.ctrl[min(k * period, len(replay.ctrl) - 1)]).float()
    return torch.zeros(environment.num_envs, environment.num_actions)


def test_demonstration_meets_its_targets_in_order(chain):
    shown = chain.demonstrated
    assert shown is not None
    assert chain.chained == (0, 1, 2)
    assert (np.diff(shown.stage) >= 0).all()
    assert list(shown.start) == [0, 1, 2]
    for stage in (0, 1):
        assert shown.end[stage] == shown.start[stage + 1]
        # A target is met after its contact has begun, and before the next one's has.
        assert chain.events.stages[stage].start < shown.end[stage] < chain.events.stages[stage + 1].end
    with pytest.raises(TrainError, match=r"'pick'.*mm at best.*tolerance"):
        make_task(replace(CHAIN, chain=replace(CHAIN.chain, tolerance=1e-6)))


def test_world_moves_on_exactly_when_its_target_has_been_met_for_long_enough(as_shown, chain):
    environment, d = as_shown, mujoco.MjData(chain.compiled)
    environment.start_from([0, 1])
    held, stage, moves = 0, 0, []
    for k in range(environment.max_episode_length - 1):
        _, _, done, _ = environment.step(as_demonstrated(environment, k))
        if done.any():
            # The episode is over as soon as the block has come to rest.
            assert done.all()
            break
        d.qpos[:] = environment.physics.qpos[1]
        mujoco.mj_kinematics(chain.compiled, d)
        held = held + 1 if _worst_distance(chain.table, d, stage) < CHAIN.chain.tolerance else 0
        if held == CHAIN.chain.hold and stage < 2:
            stage, held = stage + 1, 0
            moves.append(k)
        assert environment.stage.tolist() == [stage, stage]
    else:
        pytest.fail("the episode ran to its last step")
    assert len(moves) == 2
    assert environment.reached.tolist() == [3, 3]
    assert environment.success.all()


def test_moving_on_is_never_worse_than_staying(as_shown):
    environment, stages, reached, completed = as_shown, [], [], []
    environment.start_from([0, 1])
    for k in range(environment.max_episode_length):
        stages.append(environment.stage.tolist()[0])
        environment.step(as_demonstrated(environment, k))
        reached.append(float(environment.terms[0, TERMS.index("reach")]))
        completed.append(float(environment.terms[0, TERMS.index("stages")]))
        if environment.done.any():
            break
    horizon = 1 / (1 - TrainCfg().ppo.discount)
    for stage in (0, 1):
        best = max(value for value, s in zip(reached, stages, strict=True) if s == stage)
        least = min(value for value, s in zip(reached, stages, strict=True) if s == stage + 1)
        assert best * horizon < CHAIN.reward.completion + least * horizon
    assert [value for value in completed if value] == [CHAIN.reward.completion] * 3


def test_insertion_is_paid_when_the_block_has_come_to_rest_and_not_before(as_shown):
    environment, stages = as_shown, TERMS.index("stages")
    environment.start_from([0, 1])
    rest = round(CHAIN.chain.rest / environment.control_step)
    inserted = round(3.15 / environment.control_step)
    paid, in_place = [], []
    # The block is lifted out of the hole before it has rested there, and put back.
    lifted = [*range(inserted), *range(inserted, inserted - 15, -1), *range(inserted - 15, inserted)]
    for k in [*lifted, *[inserted] * 2 * rest]:
        environment.step(as_demonstrated(environment, k))
        paid.append(float(environment.terms[0, stages]))
        in_place.append(bool(environment.success[0]))
        if environment.done[0]:
            break
    assert [value for value in paid if value] == [CHAIN.reward.completion] * 3
    assert paid[-1]
    assert all(in_place[-rest:])
    assert any(in_place[:-rest])


def test_observation_shows_the_stage_that_the_world_is_in(chain, drawn):
    environment = make_environment(chain, replace(CHAIN, worlds=len(drawn.qpos)), drawn, device="cpu")
    environment.start_from(range(len(drawn.qpos)))
    assert environment.stage.tolist() == drawn.stage.tolist()
    shown = environment.observation[:, environment.layout.base :].numpy().reshape(len(drawn.qpos), -1, 13)
    d, table = mujoco.MjData(chain.compiled), chain.table
    for i in range(0, len(drawn.qpos), 7):
        d.qpos[:] = drawn.qpos[i]
        d.mocap_pos[:], d.mocap_quat[:] = drawn.mocap[i, :, :3], drawn.mocap[i, :, 3:]
        mujoco.mj_kinematics(chain.compiled, d)
        s = int(drawn.stage[i])
        assert (shown[i, :, 0] > 0).tolist() == table.used[s].tolist()
        assert np.linalg.norm(shown[i, :, 4:7], axis=1).max() == pytest.approx(
            _worst_distance(chain.table, d, s), abs=1e-6
        )


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_block_falls_into_the_hole_wherever_a_world_has_it(chain, engine):
    physics = _make_physics(chain, replace(CHAIN, worlds=WORLDS, engine=engine), device="cpu")
    rng = np.random.default_rng(0)
    box = np.array([HOLE, 0]) + rng.uniform(-0.03, 0.03, (WORLDS, 2))
    block = rng.uniform(-0.001, 0.001, (WORLDS, 2))
    physics.qpos[:] = torch.as_tensor(chain.replay.qpos[0]).to(physics.qpos.dtype)
    physics.qpos[:, :2] = torch.as_tensor(box + block).to(physics.qpos.dtype)
    physics.qpos[:, 2] = 0.03
    physics.mocap[0][:, 0, :2] = torch.as_tensor(box).to(physics.mocap[0].dtype)
    physics.ctrl[:] = torch.as_tensor(chain.replay.ctrl[0]).float()
    for _ in range(8):
        physics.advance()
    second = chain.objects[1]
    np.testing.assert_allclose(physics.position[:, second, :2], box, atol=1e-6)
    seated = physics.position[:, chain.objects[0]] - physics.position[:, second]
    assert chain.target_position is not None
    np.testing.assert_allclose(seated[:, 2], chain.target_position[2], atol=1e-3)
    assert seated[:, :2].abs().max() < 2e-3


def test_box_of_no_fixed_place_is_as_immovable(chain):
    plain = chain.model.scene.model
    assert plain.nmocap == 1
    assert with_movable_fixtures(chain.model.scene) == chain.model.scene
    d = mujoco.MjData(chain.compiled)
    d.qpos[:] = chain.replay.qpos[-1]
    d.mocap_pos[0, 2] -= 0.001  # into the table: no contact of what cannot move with what does not
    mujoco.mj_forward(chain.compiled, d)
    table = {g for g in range(chain.compiled.ngeom) if chain.compiled.geom_bodyid[g] == 0}
    box = {g for g in range(chain.compiled.ngeom) if chain.compiled.geom_bodyid[g] == chain.objects[1]}
    assert not [c for c in d.contact if set(c.geom.tolist()) & table and set(c.geom.tolist()) & box]


def test_states_of_all_stages_keep_the_contact_chain(chain, drawn):
    d = mujoco.MjData(chain.compiled)

    def poses(qpos: np.ndarray, mocap: np.ndarray) -> np.ndarray:
        d.qpos[:] = qpos
        d.mocap_pos[:], d.mocap_quat[:] = mocap[:, :3], mocap[:, 3:]
        mujoco.mj_kinematics(chain.compiled, d)
        return np.array([d.site_xpos[chain.robot.tool], *d.xpos[list(chain.objects)]])

    home = poses(chain.replay.qpos[0], drawn.mocap[0])[0]
    fixed = np.array([[HOLE, 0, 0, 1, 0, 0, 0]])
    offsets = []
    for i, time in enumerate(drawn.time):
        tool, block, box = poses(drawn.qpos[i], drawn.mocap[i])
        then_tool, then_block, _ = poses(chain.replay.qpos[chain.replay.row(time)], fixed)
        if drawn.case[i] > 1:
            assert np.abs((block - tool) - (then_block - then_tool)).max() < CHAIN.reset.slip
        elif drawn.begins[i]:
            assert np.abs(tool - home).max() < 1e-3
        assert np.abs(box - fixed[0, :3]).max() <= CHAIN.reset.place[1]
        offsets.append(box - fixed[0, :3])
    assert np.ptp(offsets, axis=0)[:2].min() > CHAIN.reset.place[1]
    assert set(drawn.stage) == {0, 1, 2}
    assert set(drawn.case) == {1, 2, 3}
    assert 0.1 < drawn.begins.mean() < 0.5
    assert not drawn.stage[drawn.begins].any()


def test_states_slide_into_the_hole_as_often_as_the_hand_moves_there(chain):
    shown = chain.demonstrated
    assert shown is not None
    sampled = {
        share: sample_reset_states(
            chain, replace(CHAIN.reset, along_path=share, free=0.0, demonstrated=1.0), 0, count=120
        )
        for share in (0.0, 1.0)
    }
    d = mujoco.MjData(chain.compiled)

    def height(qpos: np.ndarray) -> float:
        d.qpos[:] = qpos
        mujoco.mj_kinematics(chain.compiled, d)
        return float(d.site_xpos[chain.robot.tool][2])

    spread = {}
    for share, states in sampled.items():
        heights = np.sort(
            [height(q) for q, stage in zip(states.qpos, states.stage, strict=True) if stage == chain.stage]
        )
        spread[share] = np.diff(heights).max() / np.ptp(heights)
    # Sampled in time, many states are at the ends of the motion, and gaps are between.
    assert spread[1.0] < spread[0.0]


def test_another_state_of_the_same_stage_takes_the_place_of_a_discarded_one(chain):
    # So large displacements that most states in the hole overlap.
    wild = replace(CHAIN.reset, along_path=0.0, demonstrated=0.0, free=0.25, position=0.02)
    states = sample_reset_states(chain, wild, 0, count=400)
    assert states.discarded["overlapping"] > 40
    inner = states.stage[~states.begins]
    shares = np.bincount(inner, minlength=3) / len(inner)
    assert np.abs(shares - 1 / 3).max() < 0.08
    assert states.begins.mean() == pytest.approx(0.25, abs=0.06)


def test_saved_chain_is_gone_on_with_exactly(chain, drawn):
    torch.manual_seed(0)
    environment = make_environment(chain, replace(CHAIN, worlds=16), drawn, device="cpu")
    action = torch.rand(60, 16, environment.num_actions) * 2 - 1
    for k in range(10):
        environment.step(action[k])
    state, random = environment.state(), torch.get_rng_state()
    runs = []
    for _ in range(2):
        environment.restore(state)
        torch.set_rng_state(random)
        found = [(environment.step(action[k])[0]["policy"], environment.stage.clone()) for k in range(10, 60)]
        runs.append([torch.stack(parts) for parts in zip(*found, strict=True)])
    assert len(torch.unique(runs[0][1])) == 3
    for first, again in zip(*runs, strict=True):
        torch.testing.assert_close(first, again, rtol=0, atol=0)
    del state["stage"]
    with pytest.raises(TrainError, match="lacks"):
        environment.restore(state)


def test_evaluation_reports_how_many_targets_were_met_in_order(chain):
    cfg = replace(CHAIN, worlds=4, reset=replace(CHAIN.reset, free=1.0, place=(0.0, 0.0)))
    states = sample_reset_states(chain, cfg.reset, 0, count=6)
    environment = make_environment(chain, cfg, states, device="cpu")
    step = iter(range(10_000))
    found = run_episodes(environment, lambda _: as_demonstrated(environment, next(step)), states)
    # Of the second batch nothing is reached: its commands are those at the demonstration's end.
    assert found.reached.tolist() == [3, 3, 3, 3, 0, 0]
    assert found.met == {"pick": 4, "align": 4, "insert": 4}
    assert found.success.tolist() == [True] * 4 + [False] * 2
    assert "in order: pick 66.7%, align 66.7%, insert 66.7%" in found.sentence()


def test_single_stage_has_no_chain():
    task = make_task(SETTINGS)
    assert task.demonstrated is None
    assert task.chained == (task.stage,)


@pytest.mark.gpu
@pytest.mark.parametrize("fuse", [False, True])
def test_captured_chain_moves_on_as_one_step_after_the_other(chain, drawn, fuse):
    made = []
    for capture in ("none", "step"):
        cfg = replace(CHAIN, engine="warp", worlds=len(drawn.qpos), capture=capture, fuse=fuse and capture == "step")
        made.append(make_environment(chain, cfg, drawn, device="cuda:0"))
        made[-1].start_from(range(len(drawn.qpos)))
    kept = torch.ones(len(drawn.qpos), dtype=torch.bool, device="cuda")
    for _ in range(4):
        shown = [one.step(torch.zeros(one.num_envs, one.num_actions, device="cuda")) for one in made]
        kept &= ~(shown[0][2] | shown[1][2])  # new states are drawn where episodes end, and not the same
        assert kept.float().mean() > 0.5
        torch.testing.assert_close(shown[0][1][kept], shown[1][1][kept], atol=1e-3, rtol=1e-3)
        assert (made[0].stage == made[1].stage)[kept].float().mean() > 0.95
    assert made[1].stage.unique().tolist() == [0, 1, 2]
