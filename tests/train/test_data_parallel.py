"""Several processes train one policy; torchrun starts them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from data_parallel_training import make_run, updated

from concent_warp.cli import main
from concent_warp.errors import TrainError
from concent_warp.train.learning.distributed import DistributedProcess
from concent_warp.train.learning.ppo import CHECKPOINT
from concent_warp.train.run import train_run

SCRIPT = Path(__file__).with_name("data_parallel_training.py")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return where two processes left what they came to."""
    out = tmp_path_factory.mktemp("ranks")
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", str(SCRIPT), str(out)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(SCRIPT.parent), *sys.path]), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    return out


def loaded(path: Path) -> dict:
    return torch.load(path, weights_only=True)


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(value, b[name]) for name, value in a.items())


def test_all_processes_have_one_policy_and_one_log(trained):
    first, second = (loaded(trained / f"rank{rank}.pt") for rank in range(2))
    assert same(first["weights"], second["weights"])
    assert first["log"] == second["log"]
    assert first["steps"] == second["steps"] == 4 * 4 * 4 * 2
    assert first["log"]["steps"] == 4 * 4 * 2
    assert int(first["weights"]["obs_normalizer.count"]) == first["steps"]


def test_each_process_has_worlds_of_its_own(trained):
    first, second = (rank["environment"]["qpos"] for rank in loaded(trained / "whole" / CHECKPOINT)["ranks"])
    assert first.shape == second.shape
    difference = (first[:, None, :3] - second[None, :, :3]).abs().amax(dim=-1)
    assert difference.min() > 1e-6


def test_update_is_that_of_one_process_with_the_worlds_of_both(trained):
    alone, shared = updated(DistributedProcess()), loaded(trained / "updated0.pt")
    assert same(shared, loaded(trained / "updated1.pt"))
    before = updated(DistributedProcess(), epochs=0)
    assert not same(alone, before)
    for name, value in alone.items():
        # Adam divides by the size of the gradient: of a weight with hardly any, rounding decides the step.
        change = torch.linalg.vector_norm(value.double() - before[name].double())
        error = torch.linalg.vector_norm(shared[name].double() - value.double())
        assert float(error) <= 1e-4 * float(change), name


def test_policy_is_not_that_of_a_single_process(trained):
    trainer, last = train_run(make_run(), None, device="cpu")
    assert last is not None
    assert last.steps == loaded(trained / "rank0.pt")["steps"] / 2
    assert not same(trainer.algorithm.save()["actor_state_dict"], loaded(trained / "rank0.pt")["weights"])


def test_resumed_training_is_the_same_as_one_that_was_not_stopped(trained):
    whole, parts = (loaded(trained / name / CHECKPOINT) for name in ("whole", "parts"))
    assert same(whole["actor_state_dict"], parts["actor_state_dict"])
    assert same(whole["critic_state_dict"], parts["critic_state_dict"])
    for a, b in zip(whole["ranks"], parts["ranks"], strict=True):
        assert same(a["environment"], b["environment"])
        assert torch.equal(a["random"]["cpu"], b["random"]["cpu"])


def test_what_stops_one_process_stops_all(trained):
    assert [(trained / f"said{rank}").read_text() for rank in range(2)] == ["not in this process."] * 2


def test_checkpoint_wants_as_many_processes_as_it_was_made_by(trained):
    with pytest.raises(TrainError, match="another number of processes; expected 2, found 1"):
        train_run(make_run(), trained / "whole", device="cpu", resume=True)


def test_each_process_takes_a_gpu_and_seeds_of_its_own(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    processes = [DistributedProcess(rank, 2, rank, 2) for rank in range(2)]
    assert [r.device() for r in processes] == ["cuda:0", "cuda:1"]
    assert [r.device("cpu") for r in processes] == ["cpu", "cpu"]
    assert processes[0].seed(5) == DistributedProcess().seed(5) == 5
    assert len({DistributedProcess(rank, 4).seed(seed) for rank in range(4) for seed in range(4)}) == 16
    with pytest.raises(TrainError, match="its own GPU"):
        processes[0].device("cuda:1")


def test_more_processes_than_gpus_are_refused_in_one_sentence(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    started = {"TORCHELASTIC_RUN_ID": "1", "RANK": "0", "WORLD_SIZE": "2", "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "2"}
    for name, value in started.items():
        monkeypatch.setenv(name, value)
    assert main(["train", "demo.h5", "--model", "model.toml", "--out", f"{tmp_path}/run"]) == 2
    said = capsys.readouterr().err.strip()
    assert said.splitlines()[-1].startswith("concent train: there are more processes than GPUs; expected at most 1, ")
    assert not (tmp_path / "run").exists()
