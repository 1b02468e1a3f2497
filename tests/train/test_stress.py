"""The stress test, and the policy that it chooses."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from data_parallel_training import make_run
from small_insertion import CHAIN, NOTHING_VARIES, SETTINGS

from concent_warp.errors import TrainError
from concent_warp.train.cfg import EdgeCfg, RandomisationCfg, StressCfg, TrainCfg
from concent_warp.train.environment.physics import MujocoPhysics
from concent_warp.train.environment.randomisation import sample_model_fields
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.learning.best_policy import chosen_weights
from concent_warp.train.learning.metrics import read_curve
from concent_warp.train.learning.ppo import CHECKPOINT, Iteration, Trainer, load_checkpoint
from concent_warp.train.observation_cfg import SensorErrorsCfg
from concent_warp.train.policy.load import Policy
from concent_warp.train.policy.write_pretrained import write_pretrained
from concent_warp.train.resets.sample import sample_reset_states
from concent_warp.train.run import TrainingRun, train_run
from concent_warp.train.train import train
from concent_warp.train.trials.stress import stressed

QUICK = StressCfg(every=2, episodes=3, refine=1)
ACTOR = "actor_state_dict"


@pytest.fixture(scope="module")
def run() -> TrainingRun:
    return make_run()


def with_stress(run: TrainingRun, stress: StressCfg, iterations: int = 4) -> TrainingRun:
    ppo = replace(run.cfg.ppo, iterations=iterations)
    return replace(run, cfg=replace(run.cfg, stress=stress, ppo=ppo))


@pytest.fixture(scope="module")
def tested(run, tmp_path_factory) -> tuple[Trainer, Path]:
    """Return a training with a test every two iterations."""
    folder = tmp_path_factory.mktemp("tested")
    return train_run(with_stress(run, QUICK), folder, device="cpu")[0], folder


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(value, b[name]) for name, value in a.items())


def test_worlds_are_stressed_by_the_settings():
    randomisation = RandomisationCfg(
        friction=(0.25, 4.0), damping=(0.8, 1.0), joint_friction=(0.1, 0.2), perturbation_share=0.3
    )
    cfg = replace(CHAIN, worlds=7, stride=5, cone="pyramidal", randomisation=randomisation)
    conditions = {"friction": (0.125, 8.0), "grip": (0.6, 1.7), "stiffness": (0.7, 1.4), "mass": (0.5, 1.5)}
    conditions |= {"perturbation": (6.0, 0.3)}
    sensors, edges = SensorErrorsCfg(rate=60.0), EdgeCfg(count=17)
    found = stressed(cfg, replace(StressCfg(), **conditions, sensors=sensors, edges=edges))
    assert found.randomisation == replace(randomisation, **conditions, extremes=True)
    assert (found.collision, found.cone, found.stride, found.edges) == ("full", "elliptic", 1, edges)
    assert found.observation == replace(cfg.observation, sensors=sensors)
    assert found.reset == replace(cfg.reset, stuck=replace(cfg.reset.stuck, share=0.0))
    changed = ("collision", "cone", "stride", "edges", "observation", "randomisation", "reset")
    assert replace(found, **{name: getattr(cfg, name) for name in changed}) == cfg


@pytest.mark.parametrize("extremes", [False, True])
def test_extremes_are_the_ends_of_the_ranges(task, extremes):
    ranges = {"friction": (0.5, 2.0), "grip": (0.8, 1.25), "stiffness": (0.9, 1.1), "damping": (0.7, 1.4)}
    cfg = replace(NOTHING_VARIES, **ranges, mass=(0.6, 1.3), joint_friction=(1.0, 2.0), extremes=extremes)
    m, robot = task.compiled, task.robot
    fields = sample_model_fields(task, 40, cfg, 0, {"dof_damping": np.full((40, m.nv), 3.0)})
    block, finger = m.body("block"), m.body("left_finger")
    friction = fields["geom_friction"][:, :, 0] / m.geom_friction[:, 0]
    factors = {
        "friction": friction[:, block.geomadr[0]],
        "grip": friction[:, finger.geomadr[0]],
        "stiffness": fields["actuator_gainprm"][:, 0, 0] / m.actuator_gainprm[0, 0],
        "damping": fields["dof_damping"][:, 0] / 3.0,
        "mass": fields["body_mass"][:, block.id] / m.body_mass[block.id],
        "joint_friction": fields["dof_frictionloss"][:, robot.dof[0]] - m.dof_frictionloss[robot.dof[0]],
    }
    ranges |= {"mass": (0.6, 1.3), "joint_friction": (1.0, 2.0)}
    for name, values in factors.items():
        low, high = ranges[name]
        at_ends = np.isclose(values, low) | np.isclose(values, high)
        assert at_ends.all() == extremes, name
        assert at_ends.any() == extremes, name
        middle = values > (low + high) / 2
        assert 8 < middle.sum() < 32, name
    # Each factor is at either end by itself.
    if extremes:
        assert len(np.unique(np.column_stack(list(factors.values())) > 1.05, axis=0)) > 8


@pytest.mark.parametrize("shapes", ["nominal", "spheres"])
def test_stress_worlds_are_the_models_own_with_smaller_steps(run, shapes):
    test = with_stress(run, StressCfg(shapes=shapes, episodes=5, refine=4)).stress_test(device="cpu")
    environment = test.environment
    assert environment.num_envs == 5
    assert test.environment is environment
    assert environment.perturbs_trials
    assert environment.estimate is not None
    assert environment._virtual is None
    m, timestep = environment.physics.model, run.task().compiled.opt.timestep
    assert m.opt.timestep == pytest.approx(timestep / 4)
    assert isinstance(environment.physics, MujocoPhysics)
    assert environment.physics._decimation == 4 * run.cfg.environment.decimation
    assert environment.control_step == pytest.approx(run.cfg.environment.decimation * timestep)
    geometry = run.model.geometry
    assert geometry is not None
    spheres = {f"block_sphere{i}" for i in range(len(geometry.of("block")))}
    assert len({m.geom(g).name for g in range(m.ngeom)} & spheres) == (len(spheres) if shapes == "spheres" else 0)
    colliding = m.geom_contype[m.geom_bodyid == m.body("block").id] != 0
    assert (colliding.sum() == 1) == (shapes == "nominal")
    assert environment.task.collidable.all()


def test_stress_test_perturbs_the_grasped_object(run):
    always = replace(run.cfg.environment, randomisation=replace(NOTHING_VARIES, perturbation_share=1.0))
    cfg = replace(run.cfg, environment=always, stress=replace(QUICK, perturbation=(2.0, 0.0)))
    test = replace(run, cfg=cfg).stress_test(device="cpu")
    forces = []

    def still(observation: object) -> torch.Tensor:
        del observation
        forces.append(test.environment.physics.wrench[:, test.environment.task.objects[0]].clone())
        return torch.zeros(test.environment.num_envs, test.environment.num_actions)

    result = test(still)
    assert len(result.success) == 3
    assert float(torch.stack(forces[1:])[..., :3].std()) == pytest.approx(2.0, rel=0.2)


def test_stress_test_is_of_the_whole_task_from_states_that_training_does_not_have(run):
    chain = replace(CHAIN, worlds=4, reset=replace(CHAIN.reset, states=6))
    cfg = TrainCfg(environment=chain, stress=replace(QUICK, episodes=6))
    test = replace(run, cfg=cfg).stress_test(device="cpu")
    states, trained = test._states, sample_reset_states(run.task(), chain.reset, cfg.seed, count=6)
    assert len(states.qpos) == 6
    assert states.begins.all()
    assert np.abs(states.mocap[:, None] - trained.mocap).max(axis=(2, 3)).min() > 1e-6


def test_states_follow_from_the_seed_and_are_not_those_that_chose_the_policy(run):
    quick = with_stress(run, QUICK)
    seeds = (None, 0, 0, 1)
    first, given, again, other = (quick.stress_test(device="cpu", seed=seed)._states.qpos for seed in seeds)
    np.testing.assert_array_equal(given, again)
    for one, another in ((first, given), (first, other), (given, other)):
        assert np.abs(one[:, None] - another).max(axis=2).min() > 1e-6
    assert len(quick.stress_test(device="cpu", episodes=2)._states.qpos) == 2


def scripted(
    trainer_of: Callable[..., Trainer], outcomes: Sequence[int]
) -> tuple[Trainer, list[dict[str, torch.Tensor]], list[Iteration]]:
    """Train with examinations of these numbers of successes; return the trainer, its policies and iterations."""
    script, policies, iterations = iter(outcomes), [], []

    def examine(policy: Callable) -> tuple[int, int]:
        torch.rand(7)  # an examination samples
        with torch.no_grad():
            policy(trainer.environment.get_observations())
        return next(script), 10

    trainer = trainer_of(lambda: examine)

    def report(this: Iteration) -> None:
        policies.append({name: value.clone() for name, value in trainer.algorithm.actor.state_dict().items()})
        iterations.append(this)

    trainer.learn(report)
    assert next(script, None) is None
    return trainer, policies, iterations


@pytest.fixture
def trainer_of(task, states, run) -> Callable[..., Trainer]:
    def make(examination: Callable | None = None, folder: Path | None = None, **stress: int) -> Trainer:
        torch.manual_seed(0)
        environment = make_environment(task, replace(SETTINGS, worlds=4), states, device="cpu")
        cfg = replace(run.cfg, stress=replace(QUICK, **{"every": 1, **stress}), ppo=replace(run.cfg.ppo, iterations=5))
        return Trainer(environment, cfg, folder, make_examination=examination)

    return make


def test_policy_that_did_best_is_kept_the_latest_of_equals(trainer_of):
    trainer, policies, iterations = scripted(trainer_of, [1, 3, 2, 3, 0])
    assert trainer.best["iteration"] == 4
    assert (trainer.best["successes"], trainer.best["episodes"]) == (3, 10)
    assert same(trainer.best[ACTOR], policies[3])
    assert not same(policies[3], policies[4])
    assert [this.log["stress success"] for this in iterations] == [0.1, 0.3, 0.2, 0.3, 0.0]
    chosen = chosen_weights(trainer.weights())
    assert same(chosen[ACTOR], policies[3])
    assert chosen["stress"] == {"iteration": 4, "successes": 3, "episodes": 10}
    assert chosen["iteration"] == 5
    assert "best" not in chosen


def test_policy_is_examined_as_often_as_stated(trainer_of):
    trainer, policies, iterations = scripted(lambda examination: trainer_of(examination, every=2), [0, 0])
    assert ["stress success" in this.log for this in iterations] == [False, True, False, True, False]
    assert same(trainer.best[ACTOR], policies[3])
    for every in (0, 6):
        trainer = scripted(lambda examination, every=every: trainer_of(examination, every=every), [])[0]
        assert trainer.best == {}
        assert chosen_weights(trainer.weights())[ACTOR] is not None


def test_training_goes_on_as_without_the_examination(trainer_of):
    examined = scripted(trainer_of, [0, 1, 2, 3, 4])[0]
    plain = trainer_of()
    plain.learn()
    assert plain.best == {}
    for name in ("actor", "critic"):
        assert same(*(getattr(one.algorithm, name).state_dict() for one in (examined, plain))), name


def test_training_goes_on_as_without_the_test(run, tested):
    plain = train_run(with_stress(run, replace(QUICK, every=0)), None, device="cpu")[0]
    for name in ("actor", "critic"):
        assert same(*(getattr(one.algorithm, name).state_dict() for one in (tested[0], plain))), name
    assert plain.best == {}
    assert tested[0].best["episodes"] == 3
    assert tested[0].best["iteration"] in (2, 4)
    rows = read_curve(tested[1])
    assert ["stress success" in row for row in rows] == [False, True, False, True]
    assert all(0 <= row["stress success"] <= 1 for row in rows[1::2])


def test_loaded_policy_is_the_one_that_did_best(tested, tmp_path):
    trainer, folder = tested
    best = trainer.best
    policy = Policy.load(folder)
    assert policy.stress == (best["successes"], 3)
    assert same(policy.weights[ACTOR], best[ACTOR])
    assert policy.weights["iteration"] == 4
    write_pretrained(policy, tmp_path / "small")
    small = Policy.load(tmp_path / "small")
    assert small.stress == policy.stress
    assert same(small.weights[ACTOR], best[ACTOR])


def test_resumed_training_keeps_the_best_policy(trainer_of, tmp_path):
    scripted(lambda examination: trainer_of(examination, tmp_path), [2, 9, 4, 3, 1])
    resumed = trainer_of(lambda: pytest.fail("there is nothing more to examine"))
    resumed.resume(tmp_path / CHECKPOINT)
    assert resumed.best["iteration"] == 2
    assert same(resumed.best[ACTOR], load_checkpoint(tmp_path / CHECKPOINT)["best"][ACTOR])
    resumed.cfg = replace(resumed.cfg, ppo=replace(resumed.cfg.ppo, iterations=7))
    resumed._make_examination = lambda: lambda _: (8, 10)
    resumed.learn()
    assert resumed.iteration == 7
    assert resumed.best["iteration"] == 2


def test_policy_of_a_training_without_a_test_is_the_last(run, trainer_of, tmp_path):
    trainer_of(folder=tmp_path).learn()
    run.save(tmp_path)
    policy = Policy.load(tmp_path)
    assert policy.stress is None
    assert same(policy.weights[ACTOR], load_checkpoint(tmp_path / CHECKPOINT)[ACTOR])
    weights = {ACTOR: {"a": torch.ones(1)}, "iteration": 3}
    for best in ({}, {"best": {}}):
        assert chosen_weights({**weights, **best})[ACTOR] == weights[ACTOR]
        assert "stress" not in chosen_weights({**weights, **best})


@pytest.mark.parametrize("best", [{"iteration": 2}, {ACTOR: 3}, 7])
def test_best_policy_without_weights_is_refused(best):
    with pytest.raises(TrainError, match="best policy has no weights"):
        chosen_weights({ACTOR: {}, "best": best})


def test_training_returns_the_policy_that_did_best(run):
    one = with_stress(run, replace(QUICK, every=1), iterations=1)
    policy = train(one.model, one.recording, one.cfg, events=one.events, device="cpu")
    assert policy.stress is not None
    assert policy.stress[1] == 3


def test_episodes_with_dropped_contacts_are_repeated_with_more_room(run):
    few = replace(run.cfg.environment, engine="warp", episode=0.2)
    small = replace(run, cfg=replace(run.cfg, environment=few, stress=replace(QUICK, episodes=2)))
    test = small.stress_test(device="cpu")
    assert (test._cfg.nconmax, test._cfg.njmax) == (None, None)
    test._cfg = replace(test._cfg, nconmax=2, njmax=64)
    with pytest.warns(UserWarning, match="contacts were dropped in the stress test"):
        found = test(lambda observation: torch.zeros(observation.batch_size[0], run.task().robot.actions))
    assert len(found.success) == 2
    buffers = test.environment.buffers
    assert buffers is not None
    assert buffers[0] > 2
    assert test.environment.read_log()["overflow"] == 0
