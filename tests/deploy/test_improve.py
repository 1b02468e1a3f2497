"""Rounds of improvement."""

from __future__ import annotations

import json
import shlex
import shutil
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import tyro

import concent_warp as cw
from concent_warp.cli import main
from concent_warp.deploy.improve.mend import Mend, advice, mend
from concent_warp.deploy.improve.page import chart
from concent_warp.deploy.improve.rounds import RoundsProgress
from concent_warp.deploy.improve.steps import Setting, training_settings, trial_files, with_effects
from concent_warp.deploy.setting_options import as_options, changed_settings, with_settings
from concent_warp.recording.formats.hdf5 import write_hdf5
from tests.scenes.swinging import DAMPING, drawing, swung

SLOW = cw.EvaluateCfg(action_scale=0.05)
CFG = cw.ImproveCfg(
    rounds=1, iterations=2, worlds=4, evaluate=SLOW,
    explain=cw.ExplainCfg(repetitions=1, most_trials=1, successes=0, simulated=2, diagnose=False),
)  # fmt: skip
"""A round in seconds."""


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> cw.Policy:
    """The policy that comes with the package, of whose training few initial states are sampled."""
    shipped, folder = cw.load_policy("shape_sorter"), tmp_path_factory.mktemp("policy") / "shape_sorter"
    shutil.copytree(shipped.folder, folder)
    few = {"environment.reset.states": 20, "stress.episodes": 4}
    with_settings(shipped.run.cfg, few).save(folder / "train.toml")
    return cw.load_policy(folder)


@pytest.fixture(scope="module")
def trials(policy: cw.Policy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two trials that fail since the robot is too slow."""
    folder = tmp_path_factory.mktemp("trials")
    result = cw.evaluate(policy, SLOW, episodes=2, device="cpu", record=folder)
    assert not result.success.any()
    return folder


@pytest.fixture(scope="module")
def interrupted(policy: cw.Policy, trials: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of rounds that were interrupted twice and end where trials of the second round are missing."""
    out = tmp_path_factory.mktemp("rounds") / "out"

    def run(stop: str) -> cw.Improved:
        def progress(share: float, text: str) -> None:
            shares.append(share)
            if stop and stop in text:
                raise KeyboardInterrupt

        shares: list[float] = []
        try:
            return cw.improve(
                policy, policy.run.recording, CFG, trials=trials, device="cpu", out=out, progress=progress
            )
        finally:
            assert shares == sorted(shares)

    with pytest.raises(KeyboardInterrupt):
        run("replaying simulated trials")
    assert json.loads((out / "round_1" / "round.json").read_text())["done"] == ["trials"]
    with pytest.raises(KeyboardInterrupt):
        run("training")
    assert json.loads((out / "round_1" / "round.json").read_text())["done"] == ["trials", "explain", "model"]
    explained = (out / "round_1" / "explanation" / "explanation.json").stat().st_mtime_ns
    found = run("")
    assert found.ending == "waiting"
    assert (out / "round_1" / "explanation" / "explanation.json").stat().st_mtime_ns == explained
    return out


def test_a_round_explains_trains_on_and_waits_for_trials_of_a_robot(interrupted: Path, trials: Path) -> None:
    document = json.loads((interrupted / "improve.json").read_text())
    first, second = document["rounds"]
    assert document["ending"] == "waiting"
    assert str(trials / "round_2") in document["reason"]
    assert document["policy"] == second["policy"] == str(interrupted / "round_1" / "policy")
    assert (first["successes"], first["trials"], first["cause"]) == (0, 2, "policy")
    assert first["done"] == ["trials", "explain", "model", "train"]
    assert first["mend"] == "trained on with --environment.reset.stuck.share 0.4"
    trained = cw.load_policy(document["policy"])
    assert trained.weights["iteration"] == 2
    assert trained.run.cfg.environment.reset.stuck.share == 0.4
    assert trained.run.cfg.environment.worlds == 4


def test_commands_of_a_round_are_understood(interrupted: Path) -> None:
    document = json.loads((interrupted / "improve.json").read_text())
    lines = [*document["rounds"][0]["commands"], *document["advice"]]
    names = [understood(line)[0] for line in lines if not line.startswith("#")]
    assert names == ["explain", "train", "export"]
    given = understood(document["rounds"][0]["commands"][1])[1]
    assert given.train == cw.load_policy(document["policy"]).run.cfg
    assert given.begin_with.name == "shape_sorter"


def understood(line: str) -> tuple[str, Any]:
    """Return the command of a line, and its arguments."""
    concent, name, *arguments = shlex.split(line)
    assert concent == "concent"
    module = import_module(f"concent_warp.cli.commands.{name}")
    default = module.Arguments.default(arguments) if name == "train" else None
    config = (tyro.conf.HelptextFromCommentsOff,)
    return name, tyro.cli(module.Arguments, args=arguments, default=default, config=config)


def test_the_page_has_success_causes_and_commands(interrupted: Path) -> None:
    page = (interrupted / "improve.html").read_text()
    for text in ("Success by round", "0% to 66%", "it fails in its own simulation", "concent train", "round_2"):
        assert text in page
    assert "href='round_1/explanation.html'" in page
    assert (interrupted / "round_1" / "explanation.html").is_file()


def test_it_goes_on_with_trials_of_the_new_policy(policy: cw.Policy, interrupted: Path, trials: Path) -> None:
    before = (interrupted / "round_1" / "policy" / "checkpoint.pt").stat().st_mtime_ns
    recording = cw.load_recording(trials / "trials.h5")
    better = tuple(replace(d, success=k == 0) for k, d in enumerate(recording.demonstrations))
    (trials / "round_2").mkdir()
    try:
        write_hdf5(replace(recording, demonstrations=better), trials / "round_2" / "robot.h5")
        found = cw.improve(policy, policy.run.recording, CFG, trials=trials, device="cpu", out=interrupted)
        reached = replace(CFG, target=0.5)
        also = cw.improve(policy, policy.run.recording, reached, trials=trials, device="cpu", out=interrupted)
    finally:
        shutil.rmtree(trials / "round_2")
    assert (found.ending, also.ending) == ("rounds", "target")
    assert [one.rate for one in found.rounds] == [0.0, 0.5]
    assert (interrupted / "round_1" / "policy" / "checkpoint.pt").stat().st_mtime_ns == before
    assert "Round 2: 1 of 2 trials succeed (50 % [9, 91])." in found.sentences()


def test_in_reality_the_policy_is_tried_by_the_tool(policy: cw.Policy, tmp_path: Path) -> None:
    cfg = replace(CFG, episodes=2, target=0.0)
    found = cw.improve(policy, policy.run.recording, cfg, world="reality", device="cpu", out=tmp_path / "out")
    assert found.ending == "target"
    assert trial_files(tmp_path / "out" / "round_1", 1) == []
    (command,) = found.rounds[0].commands
    name, given = understood(command)
    assert (name, given.world, given.seed, given.episodes, given.cfg) == ("evaluate", "reality", 1, 2, SLOW)
    assert len(cw.load_recording(found.rounds[0].files[0]).demonstrations) == 2


def swinging(tmp_path: Path, *effects: str) -> tuple[Setting, cw.ImprovementRound]:
    """A round of a pendulum whose model lacks its damping; the trial failed."""
    recording = swung(seconds=1.0)
    model = drawing(recording)
    for name in effects:
        model = model.add_effect(name)
    model.save(tmp_path / "model.toml")
    failed = tuple(replace(d, success=False) for d in recording.demonstrations)
    write_hdf5(replace(recording, demonstrations=failed), tmp_path / "trials.h5")
    one = cw.ImprovementRound(1, str(tmp_path), files=(str(tmp_path / "trials.h5"),), cause="physics")
    return Setting(recording, CFG, "cpu"), one


def test_missing_effects_are_added_and_fitted_to_failed_trials(tmp_path: Path) -> None:
    setting, one = swinging(tmp_path)
    (tmp_path / "out").mkdir()
    missing = (
        cw.MissingEffect("joint_friction", ("hinge",), ("torque[hinge]",), (0.001,)),
        cw.MissingEffect("joint_damping", ("hinge",), ("damping[hinge]",), (0.5 * DAMPING,)),
    )
    chosen = Mend("added", missing)
    after, fitted = with_effects(setting, one, chosen, tmp_path / "out", lambda *_: None)
    assert fitted is not None
    model = cw.load_model(tmp_path / "out" / "model.toml")
    assert [a.effect.name for a in model.effects] == ["joint_friction", "joint_damping"]
    assert model.effects[1].values[0] == pytest.approx(DAMPING, rel=0.1)
    assert [effect.name for effect in after.fitted] == ["joint_friction", "joint_damping"]
    assert after.fitted[1].values == model.effects[1].values
    for line in after.commands:  # the commands make the same model
        assert main(shlex.split(line.replace("/out/", "/again/"))[1:]) == 0 or "failed.h5" in line
    shutil.copy(tmp_path / "out" / "failed.h5", tmp_path / "again" / "failed.h5")
    assert main(shlex.split(after.commands[-1].replace("/out/", "/again/"))[1:]) == 0
    again = cw.load_model(tmp_path / "again" / "model.toml")
    assert again.effects[1].values == pytest.approx(model.effects[1].values)


def test_effects_are_fitted_to_the_free_motion_that_they_were_found_in(tmp_path: Path) -> None:
    setting, one = swinging(tmp_path)
    found_in = tmp_path / "out" / "explanation" / "free_motion.h5"
    found_in.parent.mkdir(parents=True)
    write_hdf5(swung(seconds=0.5), found_in)
    damping = cw.MissingEffect("joint_damping", ("hinge",), ("damping[hinge]",), (0.5 * DAMPING,))
    after, fitted = with_effects(setting, one, Mend("added", (damping,)), tmp_path / "out", lambda *_: None)
    assert fitted is not None
    assert fitted.model.effects[0].values[0] == pytest.approx(DAMPING, rel=0.1)
    assert str(found_in) in shlex.split(after.commands[-1])
    assert not (tmp_path / "out" / "failed.h5").exists()


def test_the_model_of_an_explanation_is_taken_as_it_is(tmp_path: Path) -> None:
    setting, one = swinging(tmp_path)
    ready = tmp_path / "out" / "explanation" / "with_effects.toml"
    ready.parent.mkdir(parents=True)
    cw.load_model(tmp_path / "model.toml").add_effect("joint_damping").save(ready)
    damping = cw.MissingEffect("joint_damping", ("hinge",), ("damping[hinge]",), (0.5 * DAMPING,))
    chosen = Mend("added", (damping,))
    assert with_effects(setting, one, chosen, tmp_path / "out", lambda *_: None) == (one, None)
    assert not (tmp_path / "out" / "model.toml").exists()


def test_effects_of_the_model_are_fitted_again_by_a_command_too(tmp_path: Path) -> None:
    setting, one = swinging(tmp_path, "joint_damping")
    (tmp_path / "out").mkdir()
    after, fitted = with_effects(setting, one, Mend("again", refit=True), tmp_path / "out", lambda *_: None)
    assert fitted is not None
    assert fitted.fall > 0.5
    (effect,) = after.fitted
    assert effect.values[0] == pytest.approx(DAMPING, rel=0.05)
    shutil.move(tmp_path / "out" / "model.toml", tmp_path / "first.toml")
    assert main(shlex.split(after.commands[-1])[1:]) == 0
    assert cw.load_model(tmp_path / "out" / "model.toml").effects[0].values == pytest.approx(effect.values)
    assert with_effects(setting, one, Mend("nothing"), tmp_path / "out", lambda *_: None) == (one, None)


def test_what_is_done_follows_from_the_cause(policy: cw.Policy) -> None:
    friction = cw.MissingEffect("joint_friction", ("joint1",), ("torque[joint1]",), (1.2,))
    assert mend("physics", (friction,), policy).effects == (friction,)
    assert mend("physics", (), policy).stops
    known = replace(policy, run=replace(policy.run, model=policy.run.model.add_effect("joint_friction")))
    assert mend("physics", (), known).refit
    for cause in ("perception", "unexplained"):
        first = mend(cause, (), policy)
        assert first.settings
        assert not first.stops
        robust = with_settings(policy.run.cfg, first.settings)
        assert mend(cause, (), replace(policy, run=replace(policy.run, cfg=robust))).stops
    patient = with_settings(policy.run.cfg, mend("policy", (), policy).settings)
    assert mend("policy", (), replace(policy, run=replace(policy.run, cfg=patient))).text == "trained on"


@pytest.mark.parametrize("cause", ["perception", "physics", "unexplained"])
def test_what_the_user_has_to_do_is_understood(policy: cw.Policy, cause: str) -> None:
    names = [understood(line)[0] for line in advice(cause, policy, "my demo.h5") if not line.startswith("#")]
    assert names == (["calibrate"] if cause == "perception" else ["suggest", "diagnose", "train"])


def test_settings_are_options_of_the_command_that_understands_them() -> None:
    names: dict[str, Any] = {
        "ppo.learning_rate": 3e-4, "environment.randomise_effects": False, "ppo.hidden": (64, 32),
        "environment.randomisation.friction": (0.5, 4.0), "environment.stage": "pick", "target": 0.9,
    }  # fmt: skip
    cfg = with_settings(cw.TrainCfg(), names)
    assert changed_settings(cfg, cw.TrainCfg()) == names
    line = f"concent train demo.h5 --model model.toml {as_options(changed_settings(cfg, cw.TrainCfg()))}"
    assert understood(line)[1].train == cfg
    chain = with_settings(cw.TrainCfg.for_stage("all"), {"ppo.entropy": 0.002})
    line = f"concent train demo.h5 --model model.toml {as_options(training_settings(chain))}"
    assert line.endswith("--environment.stage all --ppo.entropy 0.002")
    assert understood(line)[1].train == chain


def test_steps_weigh_as_long_as_they_took() -> None:
    shares: list[float] = []
    progress = RoundsProgress(1, lambda share, _: shares.append(share))
    steps = ("trials", "explain", "model", "train")
    progress.measured([cw.ImprovementRound(1, "p", done=steps, seconds=(10.0, 20.0, 30.0, 30.0))])
    progress(1, "model", 0.5, "fitting")
    progress(1, "trials", 0.0, "earlier")
    progress(2, "trials", 1.0, "done")
    assert shares == pytest.approx([0.45, 0.45, 1.0])


def test_the_chart_has_a_point_and_an_interval_for_each_round() -> None:
    rounds = [cw.ImprovementRound(k, "p", successes=10 * k, trials=40) for k in (1, 2, 3)]
    drawn = chart(rounds)
    assert drawn.count("<circle") == 3
    assert all(text in drawn for text in (">25%<", ">50%<", ">75%<", "round 3"))
    assert chart([cw.ImprovementRound(1, "p")]) == ""


def test_other_trials_and_settings_are_refused(policy: cw.Policy, interrupted: Path, trials: Path) -> None:
    def again(cfg: cw.ImproveCfg) -> None:
        cw.improve(policy, policy.run.recording, cfg, trials=trials, device="cpu", out=interrupted)

    with pytest.raises(cw.ConcentError, match=r"begun with other settings.*worlds 4.*worlds 8"):
        again(replace(CFG, worlds=8))
    path, kept = trials / "trials.h5", (trials / "trials.h5").read_bytes()
    recording = cw.load_recording(path)
    try:
        write_hdf5(replace(recording, demonstrations=recording.demonstrations[:1]), path)
        with pytest.raises(cw.TrainError, match=r"trials of round 1 have changed.*round_2"):
            again(CFG)
    finally:
        path.write_bytes(kept)


def test_wrong_input_is_refused_before_anything_is_written(policy: cw.Policy, trials: Path, tmp_path: Path) -> None:
    out, recording = tmp_path / "out", policy.run.recording

    def refused(words: str, folder: Path | None, cfg: cw.ImproveCfg = CFG, **options: Any) -> None:
        with pytest.raises(cw.ConcentError, match=words):
            cw.improve(policy, options.pop("recording", recording), cfg, trials=folder, out=out, **options)
        assert not out.exists()

    other = replace(recording, demonstrations=(replace(recording[0], name="demo_7"),))
    refused("lacks the demonstration.*expected demo_0.*found demo_7", trials, recording=other)
    refused("no trials are given", None)
    refused("no such folder of trials", tmp_path / "gone")
    (tmp_path / "empty").mkdir()
    refused("there are no trials", tmp_path / "empty")
    refused("rounds", trials, cw.ImproveCfg(rounds=0))
    refused("no effect 'magic'", trials, cw.ImproveCfg(explain=cw.ExplainCfg(effects=("magic",))))
    backlash, magic = (cw.ImproveCfg(evaluate=cw.EvaluateCfg(hide=(one,))) for one in ("backlash=1", "magic=1"))
    refused("hidden effects exist only in Reality", trials, backlash)
    refused("no effect .magic. can be hidden", trials, magic, world="reality")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(cw.ConcentError, match="other things than rounds"):
        cw.improve(policy, recording, trials=trials, out=tmp_path / "mine", overwrite=True)
    assert (tmp_path / "mine" / "letter.txt").read_text() == "dear"


def test_a_damaged_state_is_one_sentence(policy: cw.Policy, interrupted: Path, trials: Path) -> None:
    state = interrupted / "round_1" / "round.json"
    kept = state.read_text()
    try:
        for text in ("{", '{"number": 1}', kept.replace('"explain"', '"dance"')):
            state.write_text(text)
            with pytest.raises(cw.TrainError, match=r"round.json.*--overwrite"):
                cw.improve(policy, policy.run.recording, CFG, trials=trials, device="cpu", out=interrupted)
    finally:
        state.write_text(kept)


def test_an_interruption_says_how_to_go_on(policy: cw.Policy, monkeypatch: Any, tmp_path: Path, capsys: Any) -> None:
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("concent_warp.deploy.improve.improve.improve", interrupt)
    demo = str(policy.folder / "demonstration.h5")
    words = ["improve", demo, "--policy", "shape_sorter", "--world", "reality", "-o", str(tmp_path / "o")]
    assert main([*words, "--overwrite"]) == 130
    said = " ".join(capsys.readouterr().err.split())
    assert f"continue with: concent {shlex.join(words)}" in said
    assert "--overwrite" not in said


def test_the_command_prints_the_rounds(policy: cw.Policy, monkeypatch: Any, tmp_path: Path, capsys: Any) -> None:
    rounds = (cw.ImprovementRound(1, "runs/insert", successes=12, trials=20, cause="physics"),)
    found = cw.Improved(rounds, "stopped", "Another recording is needed.", ("# find it", "concent suggest"), "p")
    monkeypatch.setattr("concent_warp.deploy.improve.improve.improve", lambda *_, **__: found)
    words = ["improve", str(policy.folder / "demonstration.h5"), "--policy", "shape_sorter", "-o", str(tmp_path)]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "Round 1: 12 of 20 trials succeed" in said
    assert "concent suggest" in said
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(json.dumps(found.to_json()))
    monkeypatch.chdir(tmp_path)
    assert main([word for word in words if word not in ("--policy", "shape_sorter")]) == 2
    assert "name it with --policy" in capsys.readouterr().err


def test_effects_of_an_explanation_are_named_without_what_they_act_on() -> None:
    from concent_warp.deploy.improve.mend import missing_effects

    parameter = SimpleNamespace(name="torque[joint1]", value=1.2)
    finding = SimpleNamespace(name="joint_friction(joint1, ...)", target=("joint1",), parameters=(parameter,))
    diagnosis = cast(Any, SimpleNamespace(accepted=(finding,)))
    found = cw.Explanation("physics", (), 1, 2, {}, (), (), diagnosis=diagnosis)
    assert missing_effects(found) == (cw.MissingEffect("joint_friction", ("joint1",), ("torque[joint1]",), (1.2,)),)
    assert missing_effects(replace(found, cause="unexplained")) == ()
