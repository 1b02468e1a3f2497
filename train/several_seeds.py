"""Training with several seeds, of which the policy that does best in a common stress test is kept."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from concent_warp.checkpoint_file import write_checkpoint
from concent_warp.errors import TrainError
from concent_warp.files import write_text
from concent_warp.run_folder import TRAIN_SETTINGS, UNFINISHED, plain, run_folder, write_settings
from concent_warp.train.cfg import TrainCfg
from concent_warp.train.learning.distributed import DistributedProcess
from concent_warp.train.learning.ppo import CHECKPOINT, Iteration
from concent_warp.train.policy.load import Policy
from concent_warp.train.run import check_unchanged
from concent_warp.train.trials.evaluate import Evaluation

SEEDS_FILE = "seeds.json"
"""File with the stress test of each seed's policy, in the run folder of a training with several seeds."""
TEST_SEED = 1_000_000
"""Seed of the common stress test: its episodes are neither those by which the seeds' checkpoints were chosen, nor, with
usual seeds, those of `evaluate`."""


TrainOne = Callable[[TrainCfg, Path | None, Callable[[Iteration], None]], Policy]
"""Trains with settings in a run folder, and continues what is there; calls back after each iteration."""


def train_several(
    train_one: TrainOne,
    cfg: TrainCfg,
    count: int,
    folder: Path | None,
    *,
    device: str | None,
    resume: bool,
    overwrite: bool,
    progress: Callable[[Iteration], None] | None,
) -> Policy:
    """Train a policy for each of several seeds and return the one that does best in a common stress test.

    Args:
        train_one: How to train one.
        cfg: Settings, with the first seed.
        count: Number of seeds.
        folder: Run folder; None writes none.
        device: Warp's name of the device of the stress test.
        resume: Continue the run folder's training, with more seeds if `count` is larger than it was.
        overwrite: Replace an earlier run in the folder.
        progress: Called after every iteration with the sums over the seeds so far.

    Raises:
        TrainError: The folder holds a training with a single seed.
    """
    with ExitStack() as stack:
        claimed = None
        if folder is not None:
            claimed = stack.enter_context(run_folder(folder, overwrite=overwrite, resume=resume))
            if (claimed.path / TRAIN_SETTINGS).exists() and not (claimed.path / SEEDS_FILE).exists():
                raise TrainError(
                    "the folder holds a training with one seed", where=folder, fix="choose another folder for several"
                )
            write_settings(claimed.path, {"seeds": count, **plain(cfg)})
        policies: list[Policy] = []
        done = _Sum()
        for seed in range(cfg.seed, cfg.seed + count):
            one = replace(cfg, seed=seed)
            within = None if claimed is None else claimed.path / f"seed_{seed}"
            policy = _finished(within, one)
            if policy is None:
                add = done.added_to
                policy = train_one(one, within, lambda this, add=add: progress(add(this)) if progress else None)
            policies.append(policy)
            done = done.plus(policy.weights)
        test = policies[0].run.stress_test(device=device, seed=TEST_SEED)
        results = [test(policy.act_in(test.environment)) for policy in policies]
        best = max(range(count), key=lambda i: results[i].success.sum())
        chosen = _with_result(policies[best], results[best])
        if claimed is not None:
            _write(claimed.path, chosen, policies, results)
    return replace(chosen, folder=folder or Path())


def check_several(process: DistributedProcess) -> None:
    """Check that several seeds can be trained.

    Raises:
        TrainError: There are several processes.
    """
    if not process.is_single:
        raise TrainError(
            "several seeds are trained by one process",
            found=f"{process.world_size} processes of torchrun",
            fix="start concent train without torchrun, or train each seed in a folder of its own",
        )


def check_one_seed(folder: Path) -> None:
    """Check that a folder holds no training with several seeds.

    Raises:
        TrainError: It does.
    """
    if any(folder.glob(f"seed_*/{TRAIN_SETTINGS}")):
        raise TrainError(
            "the folder holds a training with several seeds", where=folder, fix="pass --seeds, or choose another folder"
        )


def _finished(folder: Path | None, cfg: TrainCfg) -> Policy | None:
    """Return the policy of a training whose iterations are all done; None where there is something to train.

    Raises:
        TrainError: It was trained with other settings.
    """
    if folder is None or not (folder / CHECKPOINT).exists() or (folder / UNFINISHED).exists():
        return None
    policy = Policy.load(folder)
    check_unchanged(policy.run.cfg, cfg, folder)
    return policy if policy.weights["iteration"] >= cfg.ppo.iterations else None


@dataclass(frozen=True)
class _Sum:
    """Iterations, environment steps and time [s] of trainings."""

    iteration: int = 0
    steps: int = 0
    seconds: float = 0.0

    def plus(self, weights: Mapping[str, Any]) -> _Sum:
        """Return the sum with those of a checkpoint."""
        return _Sum(
            self.iteration + weights["iteration"], self.steps + weights["steps"], self.seconds + weights["seconds"]
        )

    def added_to(self, this: Iteration) -> Iteration:
        """Return an iteration with these added to its own."""
        return replace(
            this,
            iteration=self.iteration + this.iteration,
            steps=self.steps + this.steps,
            seconds=self.seconds + this.seconds,
        )


def _with_result(policy: Policy, result: Evaluation) -> Policy:
    """Return a policy with the outcome of its stress test."""
    outcome = {"iteration": policy.weights.get("stress", policy.weights)["iteration"], **_counts(result)}
    return replace(policy, weights={**policy.weights, "stress": outcome})


def _counts(result: Evaluation) -> dict[str, int]:
    """Return the numbers of successes and episodes."""
    return {"successes": int(result.success.sum()), "episodes": len(result.success)}


def _write(folder: Path, chosen: Policy, policies: Sequence[Policy], results: Sequence[Evaluation]) -> None:
    """Write the results of all policies and the training of the chosen one to the run folder."""
    lines = [
        {"seed": policy.run.cfg.seed, "chosen": policy.run is chosen.run, **_counts(result)}
        for policy, result in zip(policies, results, strict=True)
    ]
    write_text(folder / SEEDS_FILE, json.dumps(lines, indent=1) + "\n")
    chosen.run.save(folder)
    write_checkpoint(folder / CHECKPOINT, dict(chosen.weights))
