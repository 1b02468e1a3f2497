"""The whole task, learnt on a CPU: minutes."""

from dataclasses import replace

import pytest
from small_insertion import CHAIN, make_demonstration, make_events, make_model

from concent_warp.recording.recording import Recording
from concent_warp.train.cfg import PpoCfg, StressCfg, TrainCfg
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.run import TrainingRun, train_run
from concent_warp.train.trials.evaluate import run_episodes


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_all_stages_are_learnt_in_turn_on_a_cpu():
    model = make_model()
    demonstration = make_demonstration(model)
    environment = replace(CHAIN, worlds=128, reset=replace(CHAIN.reset, states=400))
    ppo = PpoCfg(iterations=150, hidden=(64, 64), learning_rate=2e-3)
    cfg = TrainCfg(environment=environment, ppo=ppo, stress=StressCfg(every=0))
    recording = Recording(model.scene.xml, (demonstration,))
    run = TrainingRun(model, recording, make_events(model, demonstration), cfg)
    trainer, _ = train_run(run, None, device="cpu")
    states = run.evaluation_states(run.task(), 64, 0)
    tried = run_episodes(make_environment(run.task(), environment, states, device="cpu"), trainer.policy(), states)
    assert tried.met["pick"] == tried.met["align"] == 64
    assert tried.rate >= 0.8
