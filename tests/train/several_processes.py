"""What each of several processes of a training does: run by torchrun, with a folder to write to."""

import sys
from dataclasses import replace
from pathlib import Path

import torch
from concent_warp.train.cfg import PpoCfg, TrainCfg, TrainError
from concent_warp.train.ranks import Ranks
from concent_warp.train.run import Run, train
from small_insertion import SETTINGS, make_demonstration, make_events, make_model

from concent_warp.recording.recording import Recording

PPO = PpoCfg(iterations=4, steps=4, hidden=(16,), epochs=2, batches=2)


def make_run() -> Run:
    model = make_model()
    demonstration = make_demonstration(model)
    environment = replace(SETTINGS, worlds=4, reset=replace(SETTINGS.reset, states=8))
    recording = Recording(model.scene.xml, (demonstration,))
    return Run(model, recording, make_events(model, demonstration), TrainCfg(environment=environment, ppo=PPO))


def rounds(run: Run, count: int) -> Run:
    return replace(run, cfg=replace(run.cfg, ppo=replace(PPO, iterations=count)))


def main(out: Path) -> None:
    ranks, run = Ranks.here(), make_run()
    with ranks.joined("cpu"):
        trainer, last = train(run, out / "whole", device="cpu", ranks=ranks)
        assert last is not None
        weights = trainer.algorithm.save()["actor_state_dict"]
        torch.save({"weights": weights, "steps": last.steps, "log": last.log}, out / f"rank{ranks.rank}.pt")
        train(rounds(run, 2), out / "parts", device="cpu", ranks=ranks)
        train(run, out / "parts", device="cpu", ranks=ranks, resume=True)
        try:
            with ranks.agreeing():
                if not ranks.first:
                    raise TrainError("not in this process")
        except TrainError as error:
            (out / f"said{ranks.rank}").write_text(str(error))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
