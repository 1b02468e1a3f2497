"""Initial states of episodes: those sampled before training, and those in which worlds got stuck during it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from made_up_task import SETTINGS, changed, made_up_states, make_environment, make_task

from concent_warp.train.environment.initial_states import InitialStates
from concent_warp.train.reset_cfg import StuckCfg

TASK = make_task()
SAMPLED = made_up_states(TASK, 4)
CONTROL_STEP = 0.1


def initial(worlds: int, **settings: float) -> InitialStates:
    cfg = replace(StuckCfg(share=0.5, after=0.3, gain=0.002, within=0.06, states=8), **settings)
    return InitialStates(SAMPLED, cfg, worlds, "cpu", CONTROL_STEP)


def state_of(worlds: int, number: float, stage: int = 1) -> tuple[torch.Tensor, ...]:
    """Return a state whose numbers all are this one, and the index of the world in hundreds."""
    m = TASK.compiled
    shapes = (m.nq,), (m.nv,), (m.nu,), (m.nmocap, 3), (m.nmocap, 4)
    world = 100 * torch.arange(worlds)
    parts = [(number + world.double()).view(-1, *[1] * len(s)).expand(worlds, *s).clone() for s in shapes]
    return *parts, torch.full((worlds,), stage, dtype=torch.int32)


def keep(
    states: InitialStates,
    number: float,
    distance: list[float],
    moving: object = True,
    counts: float = 1,
    stage: int = 1,
) -> None:
    """Offer a state with these distances to the target."""
    mask = torch.zeros(len(distance), dtype=torch.bool) | torch.as_tensor(moving)
    state = state_of(len(distance), number, stage)
    states.keep_stuck(state, torch.tensor(distance), mask, torch.tensor(float(counts)))


def stored(states: InitialStates) -> int:
    return int(states.memory["stuck stored"])


def kept(states: InitialStates, rows: int = 8) -> list[float]:
    """Return the numbers of the states in the ring buffer, row by row."""
    parts = states.at(torch.arange(4, 4 + rows))
    for part in parts[:-2]:  # but for the stage, a whole number, and whether it is before the first stage
        assert (part.flatten(1) == part.flatten(1)[:, :1]).all()
    assert set(parts[-2].tolist()) <= {0, 1}
    assert not parts[-1].any()
    return parts[0][:, 0].tolist()


def test_state_is_stuck_after_the_time_without_progress():
    states = initial(1)
    for k, distance in enumerate((0.05, 0.05, 0.05)):
        keep(states, k, [distance])
        assert stored(states) == 0
    keep(states, 3, [0.05])  # 0.3 s after the first
    assert stored(states) == 1
    assert kept(states, 2) == [3.0, 0.0]
    for k in range(4, 20):
        keep(states, k, [0.05])
    assert stored(states) == 1  # once for each time that it gets stuck
    for k, distance in enumerate((0.04, 0.041, 0.0385, 0.0385), start=20):
        keep(states, k, [distance])
    assert stored(states) == 2
    assert kept(states, 3) == [3.0, 23.0, 0.0]


def test_progress_towards_the_target_of_another_stage_counts_from_its_start():
    states = initial(1)
    keep(states, 1, [0.01], stage=0)
    for k, distance in enumerate((0.05, 0.045, 0.04, 0.035, 0.03)):  # farther than ever before, and coming nearer
        keep(states, k, [distance])
    assert stored(states) == 0
    for k in range(3):
        keep(states, k, [0.03])
    assert stored(states) == 1


def test_progress_counts_anew_where_an_episode_starts():
    states = initial(2)
    for k in range(3):
        keep(states, k, [0.02, 0.02])
    states.forget_progress(torch.tensor([True, False]))
    keep(states, 3, [0.02, 0.02])
    assert stored(states) == 1


def test_progress_is_a_decrease_by_the_gain_since_the_last_progress():
    states = initial(3)
    for k in range(20):
        keep(states, k, [0.05 - 0.0009 * k, 0.05 - 0.00045 * k, 0.05 - 0.0021 * (k % 2)])
    # The first makes progress every three steps and is never stuck, the second every five, the third once.
    assert stored(states) == 5
    assert kept(states, 5) == [103.0, 204.0, 108.0, 113.0, 118.0]


def test_state_farther_from_the_target_than_stated_is_not_stored():
    states = initial(3)
    for k in range(10):
        keep(states, k, [0.0601, 0.0599, 10.0])
    assert kept(states, 1) == [103.0]
    assert stored(states) == 1


def test_worlds_that_are_done_or_in_place_start_anew():
    states = initial(2)
    for k in range(12):
        keep(states, k, [0.05, 0.05], moving=[k not in (3, 6, 9), True])
    assert stored(states) == 1
    assert kept(states, 1) == [103.0]
    # What a world reached before does not count afterwards.
    states = initial(1)
    keep(states, 0, [0.001])
    keep(states, 1, [0.001], moving=False)
    for k in range(2, 20):
        keep(states, k, [0.059 - 0.0025 * (k - 2)])
    assert stored(states) == 0


def test_nothing_is_stored_where_states_do_not_count():
    states = initial(2)
    for k in range(10):
        keep(states, k, [0.05, 0.05], counts=0)
    assert stored(states) == 0
    assert kept(states, 2) == [0.0, 0.0]


def test_the_latest_states_replace_the_oldest():
    states = initial(2, after=CONTROL_STEP, states=3)
    distance, expected = 0.05, []
    for k in range(5):
        alone = k < 3
        for step, number in enumerate((10 * k, 10 * k + 1)):
            keep(states, number, [distance, distance], moving=[True, not alone])
            if step:
                expected += [number] if alone else [number, number + 100]
        distance -= 0.005
        present = [0.0] * 3
        for i, number in enumerate(expected):
            present[i % 3] = float(number)
        assert kept(states, 3) == present
        assert stored(states) == len(expected)
    assert stored(states) == 7
    for value in SAMPLED.qpos, SAMPLED.qvel:
        part = states.at(torch.arange(4))[value is SAMPLED.qvel]
        np.testing.assert_allclose(part, value, rtol=1e-6)


@pytest.mark.parametrize(("share", "success"), [(0.5, 1.0), (0.5, 0.4), (1.0, 1.0), (0.5, 0.0)])
@pytest.mark.parametrize("count", [0, 1, 5, 11])
def test_stuck_states_are_sampled_in_their_share_and_never_rows_that_are_empty(share, success, count):
    worlds = 6000
    states = initial(worlds, share=share, after=CONTROL_STEP)
    only = torch.arange(worlds) == 0
    for k in range(count):
        for _ in range(2):
            keep(states, 1.0, [0.05 - 0.004 * k] * worlds, moving=only)
    assert stored(states) == count
    filled = min(count, 8)
    torch.manual_seed(0)
    rows = states.sample(torch.tensor(success))
    assert rows.shape == (worlds,)
    counts = np.bincount(rows.numpy(), minlength=4)
    expected = share * success * (count > 0)
    assert (rows >= 4).float().mean() == pytest.approx(expected, abs=0.03)
    assert len(counts) <= 4 + filled
    if expected < 1:
        assert counts[:4] == pytest.approx((1 - expected) * worlds / 4, rel=0.15)
    if expected:
        assert counts[4:] == pytest.approx(expected * worlds / filled, rel=0.25)


def test_without_a_share_nothing_is_stored():
    states = initial(3, share=0.0)
    assert not states.memory
    for k in range(10):
        keep(states, k, [0.05] * 3)
    assert not states.memory
    rows = states.sample(torch.tensor(1.0))
    assert (rows < 4).all()
    assert len(states.at(torch.arange(5))[0]) == 5
    with pytest.raises(IndexError):
        states.at(torch.arange(6))


STUCK = changed(
    SETTINGS, worlds=50, max_position=1e3, dropped=10.0, lost=10.0, success=1e-6, episode=60.0,
    collision="full", chain={"tolerance": 1e-6},
    reset=replace(SETTINGS.reset, stuck=StuckCfg(share=1.0, after=0.24, within=5.0, states=64)),
)  # fmt: skip


def test_environment_starts_episodes_from_states_in_which_it_got_stuck():
    environment, physics = make_environment(make_task(STUCK), STUCK, SAMPLED)
    assert environment.control_step == pytest.approx(0.06)
    environment.reset()
    environment.episode_length_buf.zero_()
    still = torch.zeros(50, environment.num_actions)
    physics.qpos[:, :3] += torch.arange(50)[:, None] / 100 - 0.245  # by which a state is known
    physics.chosen = physics.qpos.numpy().copy(), physics.qvel.numpy().copy()
    for k in range(5):
        assert int(environment.state()["stuck stored"]) == 0, k
        environment.step(still)
    assert int(environment.state()["stuck stored"]) == 50
    stuck = [value.clone() for value in (physics.qpos, physics.qvel, physics.ctrl, *physics.mocap, environment.stage)]
    for success, share in ((0.0, 0.0), (0.5, 0.5), (1.0, 1.0)):
        environment._success_average.fill_(success)
        environment._start(torch.ones(50, dtype=torch.bool))
        found = (physics.qpos[:, None] - stuck[0]).abs().amax(dim=2)
        again = found.amin(dim=1) < 1e-5
        assert float(again.float().mean()) == pytest.approx(share, abs=0.2 * (0 < share < 1))
        rows = found.argmin(dim=1)[again]
        begun = (physics.qpos, physics.qvel, physics.ctrl, *physics.mocap, environment.stage)
        for value, expected in zip(begun, stuck, strict=True):
            torch.testing.assert_close(value[again], expected[rows], rtol=1e-6, atol=1e-6)
        assert not environment._from_start[again].any()


def test_evaluation_neither_stores_nor_uses_stuck_states():
    environment, physics = make_environment(make_task(STUCK), STUCK, SAMPLED)
    environment.start_from([0] * 50)
    physics.qpos[:, :3] += 0.01
    physics.chosen = physics.qpos.numpy().copy(), physics.qvel.numpy().copy()
    for _ in range(10):
        environment.step(torch.zeros(50, environment.num_actions))
    assert int(environment.state()["stuck stored"]) == 0
    environment._initial._stored.fill_(64)
    environment._success_average.fill_(1.0)
    environment._start(torch.ones(50, dtype=torch.bool))
    away = np.abs(physics.qpos.numpy()[:, None] - SAMPLED.qpos).max(axis=2).min(axis=1)
    assert away.max() < 1e-6
