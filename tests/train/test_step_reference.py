"""Steps of the environment against a reference in plain NumPy, tensor by tensor, over random states and actions."""

from collections import Counter

import numpy as np
import pytest
import torch
import trimesh  # noqa: F401 - imported here, as it takes seconds, and not by the first test
from made_up_task import SETTINGS, changed, made_up_qpos, made_up_states, make_environment, make_task
from reference_step import TERM_NAMES, Reference, WorldState

from concent_warp.train.environment.environment import TERMS

CASES = {
    "chain": (SETTINGS, {}),
    "later stages": (changed(reward={"kind": "engineered"}), {"first": 1}),
    "one stage": (changed(reward={"vcp": 0.4, "lenience": 0.9}), {"first": 2, "empty": 1}),
    "engineered": (changed(reward={"kind": "engineered"}, collision="full"), {"first": 1, "last": 1}),
    "without pairs": (SETTINGS, {"empty": 1}),
    "history": (changed(observation={"history": 3}), {"first": 1}),
    "no leads": (changed(observation={"leads": False, "history": 2}), {}),
    "one object": (
        changed(action={"gripper_actuators": ()}, lost=0.01, chain={"hold": 1}),
        {"objects": ("block",), "target": None},
    ),
    "no object": (SETTINGS, {"objects": (), "target": None}),
    "strict": (changed(reward={"lenience": 1.0}, capture="none"), {"target": None, "objects": ("block", "box")}),
}
STEPS = 11


def of_world(physics, i: int) -> WorldState:
    """Return a copy of a world's state."""
    mocap = torch.cat([value[i] for value in physics.mocap], dim=1)
    arrays = (physics.qpos[i], physics.qvel[i], physics.ctrl[i], mocap)
    return WorldState(*(array.double().numpy().copy() for array in arrays))


def close(found: torch.Tensor, expected: object, atol: float = 2e-5) -> None:
    """Compare with a tolerance of single precision."""
    np.testing.assert_allclose(found.double().numpy(), np.asarray(expected, dtype=float), rtol=1e-4, atol=atol)


@pytest.mark.parametrize("case", CASES)
def test_steps_are_those_of_the_reference(case):
    cfg, kinds = CASES[case]
    task = make_task(cfg, **kinds)
    states = made_up_states(task)
    environment, physics = make_environment(task, cfg, states)
    reference = Reference(task, cfg)
    rows = np.arange(cfg.worlds) % len(states.qpos)
    episodes = [reference.begin(states, row)[1] for row in rows]
    for world, episode in enumerate(episodes):
        reference.observe(of_world(physics, world), episode)
    rng, seen = np.random.default_rng(len(case)), Counter()
    physics.dropping = 6
    assert environment.max_episode_length == reference.steps > 3
    for step in range(STEPS):
        before = [of_world(physics, i) for i in range(cfg.worlds)]
        action = rng.uniform(-1.6, 1.6, (cfg.worlds, environment.num_actions))
        physics.chosen = made_up_qpos(task, rng, cfg.worlds), rng.normal(size=(cfg.worlds, task.compiled.nv))
        if step % 3 == 1:  # as before, so that targets stay met
            physics.chosen[0][:] = [one.qpos for one in before]
        if step % 4 == 2:
            physics.chosen[0][1, 0], physics.chosen[1][2, 1] = 51.0, -41.0
            physics.chosen[0][3, 7] = np.nan
        physics.flags = torch.as_tensor(rng.choice([0, 0, 1, 2, 4, 8, 6], cfg.worlds)).int()
        overflow = int((physics.flags & 6 > 0).sum())
        after = [
            WorldState(qpos, qvel, np.array([]), before[i].mocap)
            for i, (qpos, qvel) in enumerate(zip(*physics.chosen, strict=True))
        ]
        results = [reference.step(*parts) for parts in zip(before, after, action, episodes, strict=True)]
        observation, reward, done, extras = environment.step(torch.as_tensor(action, dtype=torch.float32))
        close(environment.terms, [[one.terms[name] for name in TERMS] for one in results], atol=1e-4)
        close(reward, [one.reward for one in results])
        assert done.tolist() == [one.done for one in results]
        assert extras["time_outs"].tolist() == [one.time_out for one in results]
        assert environment.failure.tolist() == [list(one.failure) for one in results]
        valid = [world for world, one in enumerate(results) if not one.failure[2]]
        assert environment.success[valid].tolist() == [results[world].success for world in valid]
        assert environment.reached.tolist() == [one.episode.met for one in results]
        means = np.mean([list(one.terms.values()) for one in results], axis=0)
        for name, mean in zip(TERM_NAMES, means, strict=True):
            assert float(extras["log"][f"/reward/{name}"]) == pytest.approx(mean, rel=1e-4, abs=1e-4)
        reference.count(results, overflow)
        assert not physics.overflow.any()
        close(environment._success_average, reference.success_average)
        for world, one in enumerate(results):
            episode = one.episode
            if one.done:
                state = of_world(physics, world)
                row = int(np.abs(states.qpos - state.qpos).max(axis=1).argmin())
                expected, episode = reference.begin(states, row)
                for name, value in vars(expected).items():
                    np.testing.assert_allclose(getattr(state, name), value, atol=1e-6)
                assert not physics.warmstart[world].any()
            else:
                close(physics.ctrl[world], one.ctrl, atol=1e-6)
            episodes[world] = episode
            seen.update(kind for kind, was in zip(("dropped", "severe", "diverged"), one.failure, strict=True) if was)
            seen.update({"success": one.success, "time out": one.time_out, "rested": one.rested})
            seen["within"] += episode.within > 0
            seen[f"stage {episode.stage}"] += 1
        assert environment.stage.tolist() == [one.stage for one in episodes]
        assert environment._from_start.tolist() == [one.from_start for one in episodes]
        assert environment._steps_within.tolist() == [one.within for one in episodes]
        assert environment._steps_at_rest.tolist() == [one.at_rest for one in episodes]
        assert environment._stages_met.tolist() == [one.met for one in episodes]
        assert environment.episode_length_buf.tolist() == [one.length for one in episodes]
        close(environment._return, [one.total for one in episodes])
        expected = [reference.observe(of_world(physics, i), episodes[i]) for i in range(cfg.worlds)]
        close(observation["policy"], expected, atol=1e-5)
        if step in (4, STEPS - 1):
            log = environment.read_log()
            expected = reference.log()
            assert log.keys() == expected.keys()
            for name, value in expected.items():
                assert log[name] == pytest.approx(value, rel=1e-4, abs=1e-4), name
    kinds_seen = {"dropped", "diverged", "success", *(f"stage {s}" for s in task.chained)}
    if cfg.collision == "vcp" and task.objects:
        kinds_seen.add("severe")
    assert {kind for kind, count in seen.items() if count} >= kinds_seen, seen
    assert seen["time out"] + seen["rested"] > 0
    assert reference.chained or not seen["rested"]
