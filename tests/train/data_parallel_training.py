"""Script of one rank of a data-parallel training: torchrun runs it with the folder to write to."""

import sys
from dataclasses import replace
from pathlib import Path

import torch
from small_insertion import SETTINGS, make_demonstration, make_events, make_model, make_task

from concent_warp.errors import TrainError
from concent_warp.recording.recording import Recording
from concent_warp.train.cfg import FinishCfg, PpoCfg, TrainCfg
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.learning.distributed import DistributedProcess
from concent_warp.train.learning.ppo import Trainer
from concent_warp.train.observation_cfg import ObservationCfg
from concent_warp.train.resets.sample import sample_reset_states
from concent_warp.train.run import TrainingRun, train_run

SENSED = replace(SETTINGS, observation=ObservationCfg(), reset=replace(SETTINGS.reset, states=8))
"""Worlds that the policy observes through sensors."""
PPO = PpoCfg(iterations=4, steps=4, hidden=(16,), epochs=2, batches=2)
FINISH = FinishCfg(share=0.25)
"""The last of four iterations, and none of two."""


def make_run() -> TrainingRun:
    model = make_model()
    demonstration = make_demonstration(model)
    environment = replace(SENSED, worlds=4)
    recording = Recording(model.scene.xml, (demonstration,))
    cfg = TrainCfg(environment=environment, ppo=PPO, finish=FINISH)
    return TrainingRun(model, recording, make_events(model, demonstration), cfg)


def rounds(run: TrainingRun, count: int) -> TrainingRun:
    return replace(run, cfg=replace(run.cfg, ppo=replace(PPO, iterations=count)))


def updated(process: DistributedProcess, epochs: int = 3) -> dict[str, torch.Tensor]:
    """Return the weights after an update from given steps of 4 worlds, distributed over the ranks; 0 epochs for none.

    All steps are one batch and none is sampled, so that the result does not depend on which rank has which worlds.
    """
    count, steps = 4, 6
    environment = replace(SENSED, worlds=count // process.world_size)
    ppo = PpoCfg(steps=steps, hidden=(16,), epochs=max(epochs, 1), batches=1, entropy=0.0)
    task = make_task(environment)
    worlds = make_environment(task, environment, sample_reset_states(task, environment.reset, 0), device="cpu")
    algorithm = Trainer(worlds, TrainCfg(environment=environment, ppo=ppo), None, process).algorithm
    algorithm.train_mode()
    observation = worlds.get_observations()
    mine = slice(process.rank * worlds.num_envs, (process.rank + 1) * worlds.num_envs)
    given = torch.Generator().manual_seed(0)
    sampled = {
        name: torch.randn(steps, count, width, generator=given)[:, mine]
        for name, width in (
            ("policy", observation["policy"].shape[1]), ("truth", observation["truth"].shape[1]),
            ("action", worlds.num_actions), ("returns", 1), ("gain", 1),
        )
    }  # fmt: skip
    none = torch.zeros(worlds.num_envs)
    with torch.inference_mode():
        for *seen, action in zip(sampled["policy"], sampled["truth"], sampled["action"].tanh(), strict=True):
            observation["policy"], observation["truth"] = (part.clone() for part in seen)
            algorithm.act(observation)
            algorithm.transition.actions = action.clone()
            algorithm.transition.actions_log_prob = algorithm.actor.get_output_log_prob(action)
            algorithm.process_env_step(observation, none, none, {})
    algorithm.storage.returns = sampled["returns"].clone()
    algorithm.storage.advantages = sampled["gain"].clone()
    if epochs:
        algorithm.update()
    networks = {"actor": algorithm.actor, "critic": algorithm.critic}
    return {f"{which}.{k}": v.clone() for which, network in networks.items() for k, v in network.state_dict().items()}


def main(out: Path) -> None:
    process, run = DistributedProcess.from_environment(), make_run()
    with process.group("cpu"):
        trainer, last = train_run(run, out / "whole", device="cpu", process=process)
        assert last is not None
        weights = trainer.algorithm.save()["actor_state_dict"]
        torch.save({"weights": weights, "steps": last.steps, "log": last.log}, out / f"rank{process.rank}.pt")
        torch.save(updated(process), out / f"updated{process.rank}.pt")
        train_run(rounds(run, 2), out / "parts", device="cpu", process=process)
        train_run(run, out / "parts", device="cpu", process=process, resume=True)
        try:
            with process.raise_together():
                if not process.is_rank_zero:
                    raise TrainError("not in this process")
        except TrainError as error:
            (out / f"said{process.rank}").write_text(str(error))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
