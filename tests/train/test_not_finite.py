"""A world that is losses or weights are not finite spoils neither the others nor the policy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_insertion import NOTHING_VARIES, SETTINGS

from concent_warp.errors import TrainError
from concent_warp.train.cfg import PpoCfg, TrainCfg
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.learning.ppo import CHECKPOINT, DIVERGED_STATE_FILE, Iteration, Trainer
from concent_warp.train.observation_cfg import ObservationCfg

WORLD, WORLDS = 2, 6
NAN = float("nan")
PPO = PpoCfg(iterations=2, steps=4, hidden=(16,), epochs=2, batches=2)
PLACES = ("qpos", "qvel", "ctrl", "warmstart")
engines = pytest.mark.parametrize("engine", ["mujoco", "warp"])


def made(task, states, engine: str) -> Environment:
    torch.manual_seed(0)
    # Late commands and tracked poses are kept for a while, and must be forgotten with the rest of a world.
    late = replace(NOTHING_VARIES, delay=(0.01, 0.02))
    cfg = replace(SETTINGS, worlds=WORLDS, engine=engine, decimation=2, episode=0.4, randomisation=late)
    cfg = replace(cfg, observation=ObservationCfg())
    return make_environment(task, cfg, states, device="cpu")


def run(environment: Environment, spoil: dict[str, float] | None) -> list[tuple[torch.Tensor, ...]]:
    """Return what 12 steps give, something of one world spoilt before the third."""
    torch.manual_seed(1)
    environment.start_from(list(range(WORLDS)))
    environment.read_log()
    found = []
    for k in range(12):
        if k == 2:
            for place, value in (spoil or {}).items():
                getattr(environment.physics, place)[WORLD, -1] = value
        action = 0.3 * torch.sin(torch.arange(WORLDS * environment.num_actions) + k).reshape(WORLDS, -1)
        observation, reward, done, _ = environment.step(action)
        state = [getattr(environment.physics, place).clone() for place in PLACES]
        found.append((observation["policy"], reward, done, *state))
    return found


@pytest.mark.parametrize(
    ("engine", "place"),
    # C MuJoCo takes the warm start that is given only together with a state.
    [
        (engine, place)
        for engine in ("mujoco", "warp")
        for place in PLACES
        if (engine, place) != ("mujoco", "warmstart")
    ],
)
def test_what_is_not_finite_stays_in_its_world_and_goes_with_its_episode(task, states, engine, place):
    whole = run(made(task, states, engine), None)
    environment = made(task, states, engine)
    spoilt = run(environment, {place: NAN})
    others = torch.arange(WORLDS) != WORLD
    for k, (before, after) in enumerate(zip(whole, spoilt, strict=True)):
        for a, b in zip(before, after, strict=True):
            torch.testing.assert_close(a[others], b[others], rtol=0, atol=0)
            assert torch.isfinite(b.double()).all()
        assert bool(after[2][WORLD]) == (k == 2)
    assert environment.read_log()["diverged worlds"] == 1
    diverged = environment.diverged_state()
    assert diverged is not None
    if place != "warmstart":
        assert np.isnan(diverged[place][-1])


@engines
def test_kept_state_diverges_again(task, states, engine):
    environment = made(task, states, engine)
    run(environment, {"qvel": 1e9})
    diverged = environment.diverged_state()
    assert diverged is not None
    assert diverged["world"] == WORLD
    again = made(task, states, engine)
    again.start_from(list(range(WORLDS)))
    for name in ("qpos", "qvel", "ctrl"):
        state = getattr(again.physics, name)
        state[0] = torch.as_tensor(diverged[name]).to(state.dtype)
    for state, name in zip(again.physics.mocap, ("mocap_pos", "mocap_quat"), strict=True):
        assert diverged[name].shape == state[0].shape
        state[0] = torch.as_tensor(diverged[name]).to(state.dtype)
    again.step(torch.zeros(WORLDS, again.num_actions))
    assert again.failure[:, 2].tolist() == [True, *[False] * (WORLDS - 1)]


@engines
def test_policy_is_the_same_whether_a_world_ends_not_finite_or_too_fast(task, states, engine, tmp_path):
    found = []
    for value in (NAN, 1e9):
        environment = made(task, states, engine)
        spoil_once(environment, value)
        trainer = Trainer(environment, TrainCfg(environment=SETTINGS, ppo=PPO), tmp_path / str(value))
        (tmp_path / str(value)).mkdir()
        environment.reset()
        trainer.learn()
        assert sum(this.log["diverged worlds"] for this in trainer.history) == 1
        with np.load(tmp_path / str(value) / DIVERGED_STATE_FILE) as diverged:
            assert np.isnan(diverged["qvel"][0]) if value != value else diverged["qvel"][0] == value
        found.append(trainer.algorithm.save())
    for name in ("actor_state_dict", "critic_state_dict"):
        for key, weight in found[0][name].items():
            assert torch.isfinite(weight).all()
            assert torch.equal(weight, found[1][name][key])


def spoil_once(environment: Environment, value: float) -> None:
    """Spoil a velocity of a world in the sixth step of an environment."""
    advance, count = environment.physics.advance, 0

    def spoilt() -> None:
        nonlocal count
        count += 1
        if count == 6:
            environment.physics.qvel[WORLD, 0] = value
            environment._before[1][WORLD, 0] = value
        advance()

    environment.physics.advance = spoilt  # pyright: ignore[reportAttributeAccessIssue]


def test_training_that_diverges_stops_and_keeps_its_last_checkpoint(task, states, tmp_path):
    environment = made(task, states, "mujoco")
    cfg = TrainCfg(checkpoint=1, environment=SETTINGS, ppo=replace(PPO, iterations=8, schedule="fixed"))
    trainer = Trainer(environment, cfg, tmp_path)

    def spoil(this: Iteration) -> None:
        if this.iteration == 2:
            trainer.algorithm.optimizer.param_groups[0]["lr"] = 1e30

    with pytest.raises(TrainError, match="losses or weights are not finite"):
        trainer.learn(spoil)
    saved = torch.load(tmp_path / CHECKPOINT, weights_only=True)
    assert 2 <= saved["iteration"] < 8
    assert all(torch.isfinite(weight).all() for weight in saved["actor_state_dict"].values())
