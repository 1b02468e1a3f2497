"""Default settings of a training depend on its stage."""

import pytest
import tyro

import concent_warp as cw
from concent_warp.cli.commands.train import Arguments, given_stage, status
from concent_warp.train.cfg import FinishCfg
from concent_warp.train.learning.ppo import Iteration

GIVEN = ["demo.h5", "--model", "model.toml"]


def read(*options: str) -> cw.TrainCfg:
    """Return the settings that options lead to."""
    given = [*GIVEN, *options]
    config = (tyro.conf.HelptextFromCommentsOff,)
    return tyro.cli(Arguments, args=given, default=Arguments.default(given), config=config).cfg()


@pytest.mark.parametrize("options", [["--stage", "all"], ["--stage=all"], ["--environment.stage", "all"]])
def test_the_chain_has_defaults_of_its_own(options):
    cfg = read(*options)
    assert cfg == cw.TrainCfg.for_stage("all")
    assert cfg != cw.TrainCfg(environment=cw.EnvironmentCfg(stage="all"))
    assert read(*options, "--worlds", "64").environment.worlds == 64
    assert read(*options, "--environment.action.turn", "0.006").environment.action.turn == 0.006


@pytest.mark.parametrize("options", [[], ["--stage", "pick"], ["--environment.stage=insert"], ["--worlds", "4096"]])
def test_single_stages_have_those_of_the_settings(options):
    stage = given_stage([*GIVEN, *options])
    assert read(*options) == cw.TrainCfg(environment=cw.EnvironmentCfg(stage=stage))


def test_the_short_form_of_the_stage_has_precedence():
    assert given_stage(["--environment.stage", "pick", "--stage", "all"]) == "all"
    assert given_stage(["--stage", "pick", "--environment.stage", "all"]) == "pick"
    assert read("--stage", "pick", "--environment.stage", "all").ppo == cw.PpoCfg()


def test_progress_says_when_a_training_finishes():
    cfg = cw.TrainCfg(ppo=cw.PpoCfg(iterations=4), finish=FinishCfg(share=0.5))
    said = [status(Iteration(k, 100 * k, 1.0, 0.5, 0.5, 50.0, {"success": 0.5}), cfg) for k in range(1, 9)]
    assert [text.startswith("finish, ") for text in said] == [False, False, True, True] * 2
    assert said[0] == "100 steps, success 50.0%, 50 steps/s"
