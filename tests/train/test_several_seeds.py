"""Training with several seeds, of which the best in a common stress test is kept."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from data_parallel_training import make_run

from concent_warp.errors import ConcentError, TrainError
from concent_warp.train.cfg import StressCfg, TrainCfg
from concent_warp.train.learning.distributed import DistributedProcess
from concent_warp.train.learning.ppo import CHECKPOINT, Iteration
from concent_warp.train.policy.load import Policy
from concent_warp.train.several_seeds import SEEDS_FILE, TEST_SEED, check_several
from concent_warp.train.train import train

MADE = make_run()
CFG = replace(
    MADE.cfg, seed=3, ppo=replace(MADE.cfg.ppo, iterations=2), stress=StressCfg(every=0, episodes=4, refine=1)
)


def train_seeds(folder: Path | None, count: int = 2, cfg: TrainCfg = CFG, **options) -> Policy:
    return train(
        MADE.model, MADE.recording, cfg, seeds=count, events=MADE.events, device="cpu", out=folder, **options
    )  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> tuple[Policy, Path, list[Iteration]]:
    folder, iterations = tmp_path_factory.mktemp("seeds") / "run", []
    return train_seeds(folder, progress=iterations.append), folder, iterations


def same(a: Policy, b: Policy) -> bool:
    one, other = a.weights["actor_state_dict"], b.weights["actor_state_dict"]
    return all(torch.equal(value, other[name]) for name, value in one.items())


def results(folder: Path) -> list[dict]:
    return json.loads((folder / SEEDS_FILE).read_text())


def test_policy_kept_is_the_best_of_the_seeds_in_the_same_episodes(trained):
    policy, folder, _ = trained
    found = results(folder)
    assert [line["seed"] for line in found] == [3, 4]
    best = max(found, key=lambda line: line["successes"])
    assert [line["chosen"] for line in found] == [line is best for line in found]
    assert policy.run.cfg.seed == best["seed"]
    assert policy.stress == (best["successes"], 4)
    test = policy.run.stress_test(device="cpu", seed=TEST_SEED)
    for line in found:
        one = Policy.load(folder / f"seed_{line['seed']}")
        assert int(test(one.act_in(test.environment)).success.sum()) == line["successes"]


def test_run_folder_is_that_of_the_policy_kept(trained):
    policy, folder, _ = trained
    loaded = Policy.load(folder)
    assert loaded.run.cfg == policy.run.cfg
    assert loaded.stress == policy.stress
    assert same(loaded, policy)
    assert same(loaded, Policy.load(folder / f"seed_{policy.run.cfg.seed}"))
    other = next(line["seed"] for line in results(folder) if not line["chosen"])
    assert not same(loaded, Policy.load(folder / f"seed_{other}"))


def test_a_seed_is_trained_as_it_is_alone(trained, tmp_path):
    alone = train(
        MADE.model, MADE.recording, replace(CFG, seed=4), events=MADE.events, device="cpu", out=tmp_path / "alone"
    )  # fmt: skip
    assert same(alone, Policy.load(trained[1] / "seed_4"))


def test_progress_counts_all_seeds(trained):
    assert [this.iteration for this in trained[2]] == [1, 2, 3, 4]
    assert [this.steps for this in trained[2]] == [16, 32, 48, 64]
    seconds = [this.seconds for this in trained[2]]
    assert seconds == sorted(seconds)


def test_training_is_continued_where_it_was_interrupted(trained, tmp_path):
    begun = []

    def interrupt(this: Iteration) -> None:
        begun.append(this.iteration)
        if this.iteration == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="--resume"):
        train_seeds(tmp_path / "run", progress=interrupt)
    assert not (tmp_path / "run" / CHECKPOINT).exists()
    with pytest.raises(ConcentError, match="interrupted"):
        train_seeds(tmp_path / "run")
    again = []
    policy = train_seeds(tmp_path / "run", resume=True, progress=again.append)
    assert [this.iteration for this in again] == [4]
    assert results(tmp_path / "run") == results(trained[1])
    assert same(policy, trained[0])


def test_seeds_are_added_to_a_finished_training(trained, tmp_path):
    train_seeds(tmp_path / "run")
    seen = []
    train_seeds(tmp_path / "run", 3, resume=True, progress=seen.append)
    assert [this.iteration for this in seen] == [5, 6]
    found = results(tmp_path / "run")
    assert [line["seed"] for line in found] == [3, 4, 5]
    assert [line["successes"] for line in found[:2]] == [line["successes"] for line in results(trained[1])]


def test_earlier_run_is_replaced_when_all_seeds_are_trained(tmp_path):
    folder = tmp_path / "run"
    train_seeds(folder)

    def interrupt(this: Iteration) -> None:
        if this.iteration == 2:
            raise KeyboardInterrupt

    before = results(folder)
    with pytest.raises(KeyboardInterrupt):
        train_seeds(folder, cfg=replace(CFG, seed=8), overwrite=True, progress=interrupt)
    assert results(folder) == before
    train_seeds(folder, cfg=replace(CFG, seed=8), resume=True)
    assert [line["seed"] for line in results(folder)] == [8, 9]
    assert Policy.load(folder).run.cfg.seed in (8, 9)


def test_a_folder_of_one_seed_is_not_continued_with_several_nor_the_other_way(trained, tmp_path):
    one = tmp_path / "one"
    train(MADE.model, MADE.recording, CFG, events=MADE.events, device="cpu", out=one)
    content = (one / CHECKPOINT).read_bytes()
    with pytest.raises(TrainError, match="a training with one seed"):
        train_seeds(one, resume=True)
    assert (one / CHECKPOINT).read_bytes() == content
    policy, folder, _ = trained
    content = (folder / CHECKPOINT).read_bytes()
    with pytest.raises(TrainError, match=r"several seeds.*--seeds"):
        train(MADE.model, MADE.recording, policy.run.cfg, events=MADE.events, device="cpu", out=folder, resume=True)
    assert (folder / CHECKPOINT).read_bytes() == content


def test_other_settings_are_refused_on_resuming(trained):
    other = replace(CFG, environment=replace(CFG.environment, decimation=5))
    with pytest.raises(TrainError, match="decimation 10"):
        train_seeds(trained[1], cfg=other, resume=True)


def test_without_a_folder_nothing_is_written(trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert same(train_seeds(None), trained[0])
    assert list(tmp_path.iterdir()) == []


def test_impossible_numbers_of_seeds_and_processes_are_refused():
    with pytest.raises(TrainError, match="seeds is out of bounds"):
        train_seeds(None, 0)
    with pytest.raises(TrainError, match="2 processes of torchrun"):
        check_several(DistributedProcess(rank=0, world_size=2, local_rank=0, local_world_size=2))
    check_several(DistributedProcess())
