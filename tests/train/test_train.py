"""Training to success, going on exactly, and losing nothing."""

import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from small_insertion import EXACT_STATE, SETTINGS, make_demonstration, make_model

from concent_warp.cli import main
from concent_warp.errors import TrainError
from concent_warp.events.extract import extract
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.recording import Recording
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.train.cfg import FinishCfg, PpoCfg, StressCfg, TrainCfg
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.learning.metrics import CURVE, read_curve
from concent_warp.train.learning.ppo import CHECKPOINT, DIVERGED_STATE_FILE, Iteration, Trainer, load_checkpoint
from concent_warp.train.observation_cfg import ObservationCfg
from concent_warp.train.policy.load import Policy
from concent_warp.train.run import TrainingRun, train_run
from concent_warp.train.task.task import Task
from concent_warp.train.trials.evaluate import run_episodes, wilson

SHORT = PpoCfg(iterations=4, steps=4, hidden=(16,), epochs=2, batches=2)


@pytest.fixture(scope="module")
def made() -> TrainingRun:
    model = make_model()
    recording = Recording(model.scene.xml, (make_demonstration(model),))
    events = extract(model, recording[0], MujocoEngine(model, threads=1))
    environment = replace(SETTINGS, worlds=4, reset=replace(SETTINGS.reset, states=8), observation=ObservationCfg())
    return TrainingRun(model, recording, events, TrainCfg(environment=environment, ppo=SHORT))


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return torch.load(folder / CHECKPOINT, weights_only=True)["actor_state_dict"]


@pytest.mark.parametrize(("position", "iterations"), [(0.004, 14), pytest.param(0.008, 28, marks=pytest.mark.slow)])
def test_insertion_is_learnt_from_contact_events_on_a_cpu(made, position, iterations):
    """Initial states half as far from the demonstration are learnt in fewer iterations."""
    reset = replace(SETTINGS.reset, position=position)
    settings = replace(SETTINGS, observation=replace(EXACT_STATE, leads=False), reset=reset)
    learning = PpoCfg(iterations=iterations, hidden=(64, 64), learning_rate=2e-3)
    cfg = TrainCfg(environment=settings, ppo=learning, stress=StressCfg(every=0))
    trainer, last = train_run(replace(made, cfg=cfg), None, device="cpu")
    assert last is not None
    assert last.seconds < 120
    task = made.task()
    states = replace(made, cfg=cfg).evaluation_states(task, 64, 0)
    environment = make_environment(task, settings, states, device="cpu")
    torch.manual_seed(1)
    untrained = run_episodes(environment, lambda o: 2 * torch.rand(len(o["policy"]), 4) - 1, states)
    trained = run_episodes(environment, trainer.policy(), states)
    assert untrained.rate < 0.3
    assert trained.rate >= 0.8


@pytest.fixture(scope="module")
def whole(made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a training that takes all spheres after half of its iterations."""
    folder = tmp_path_factory.mktemp("whole")
    train_run(replace(made, cfg=replace(made.cfg, finish=FinishCfg(share=0.5))), folder, device="cpu")
    return folder


@pytest.mark.parametrize("stop", [1, 2, 3])
def test_resumed_training_is_the_same_as_one_that_was_not_stopped(made, whole, tmp_path, stop):
    def interrupt(this: Iteration) -> None:
        if this.iteration == stop:
            raise KeyboardInterrupt

    same = replace(made, cfg=replace(made.cfg, finish=FinishCfg(share=0.5)))
    with pytest.raises(KeyboardInterrupt):
        train_run(same, tmp_path, device="cpu", report=interrupt)
    with (tmp_path / CURVE).open("a") as file:  # a round after the checkpoint, which is done again
        file.write(json.dumps({"iteration": stop + 1, "steps": 16 * (stop + 1), "seconds": 0.1}) + "\n")
    _, last = train_run(same, tmp_path, device="cpu", resume=True)
    assert last is not None
    assert (last.iteration, last.steps) == (4, 64)
    for folder in (whole, tmp_path):
        rounds = read_curve(folder)
        assert [(row["iteration"], row["steps"]) for row in rounds] == [(1, 16), (2, 32), (3, 48), (4, 64)]
    expected, found = weights(whole), weights(tmp_path)
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("collision", "finish", "expected"),
    [
        ("vcp", FinishCfg(share=0.5, physics="spheres"), ["events", "events", "spheres", "spheres"]),
        ("vcp", FinishCfg(share=0.25), ["events", "events", "events", "shapes"]),
        ("vcp", FinishCfg(share=0), ["events"] * 4),
        ("full", FinishCfg(share=0.5, physics="spheres"), ["spheres"] * 4),
        ("full", FinishCfg(share=0.25), ["spheres", "spheres", "spheres", "shapes"]),
    ],
)
def test_more_collides_in_the_last_iterations(made, monkeypatch, collision, finish, expected):
    environment = replace(made.cfg.environment, collision=collision)
    whole, trainers, found = Trainer.learn, [], []

    def learn(self: Trainer, *args, **options):
        trainers.append(self)
        return whole(self, *args, **options)

    def note(_: Iteration) -> None:
        found.append(colliding(trainers[0].environment.task))

    monkeypatch.setattr(Trainer, "learn", learn)
    run = replace(made, cfg=replace(made.cfg, environment=environment, finish=finish))
    train_run(run, None, device="cpu", report=note)
    assert found == expected


def test_all_spheres_collide_in_the_last_iterations_where_the_scene_has_no_shapes(made, monkeypatch):
    finish, made_with = FinishCfg(share=0.5), []

    def make(task: Task, cfg, states, **options):
        made_with.append((colliding(task), options.get("refine", 1), options.get("time_constant")))
        return make_environment(task, cfg, states, **options)

    monkeypatch.setattr("concent_warp.train.run.make_environment", make)
    for shaped in (True, False):
        if not shaped:
            monkeypatch.setattr("concent_warp.train.run.with_nominal_shapes", lambda _: None)
        train_run(replace(made, cfg=replace(made.cfg, finish=finish)), None, device="cpu")
    assert made_with[:2] == [("events", 1, None), ("shapes", made_with[1][1], 0.004)]
    assert made_with[1][1] * 0.004 >= 2 * made.model.scene.model.opt.timestep
    assert made_with[2:] == [("events", 1, None), ("spheres", 1, None)]


def colliding(task: Task) -> str:
    """Return what of the objects collides in a task's physics."""
    m, bodies = task.compiled, np.array(task.objects)
    own = np.isin(m.geom_bodyid, bodies) & (m.geom_contype + m.geom_conaffinity > 0)
    kinds = set(m.geom_type[own].tolist())
    if mujoco.mjtGeom.mjGEOM_SPHERE not in kinds:
        return "shapes"
    assert task.model.geometry is not None
    return "spheres" if own.sum() == len(task.model.geometry) else "events"


def test_interruption_keeps_what_was_learnt(made, tmp_path):
    def interrupt(this: Iteration) -> None:
        if this.iteration == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_run(made, tmp_path, device="cpu", report=interrupt)
    _, last = train_run(made, tmp_path, device="cpu", resume=True)
    assert last is not None
    assert last.iteration == 4


def test_other_settings_and_foreign_files_are_refused_on_resuming(made, tmp_path):
    train_run(made, tmp_path, device="cpu")
    other = replace(made, cfg=replace(made.cfg, environment=replace(made.cfg.environment, decimation=5)))
    with pytest.raises(TrainError, match="decimation 10"):
        train_run(other, tmp_path, device="cpu", resume=True)
    (tmp_path / CHECKPOINT).write_bytes(b"nothing")
    with pytest.raises(TrainError, match="not a checkpoint"):
        train_run(made, tmp_path, device="cpu", resume=True)


def test_training_begins_with_a_policy_that_is_given(made, tmp_path):
    train_run(made, tmp_path / "first", device="cpu")
    given = weights(tmp_path / "first")
    hardly = replace(SHORT, iterations=1, learning_rate=1e-12, schedule="fixed")
    still = replace(made, cfg=replace(made.cfg, seed=1, ppo=hardly))
    same = []
    for begin_with in (None, load_checkpoint(tmp_path / "first" / CHECKPOINT)):
        trainer, _ = train_run(still, None, device="cpu", begin_with=begin_with)
        found = dict(trainer.algorithm.actor.named_parameters())
        same.append([torch.allclose(value, given[name], rtol=0, atol=1e-9) for name, value in found.items()])
    assert not all(same[0])
    assert all(same[1])
    wider = replace(still, cfg=replace(still.cfg, ppo=replace(hardly, hidden=(32,))))
    with pytest.raises(TrainError, match="another architecture"):
        train_run(wider, None, device="cpu", begin_with=load_checkpoint(tmp_path / "first" / CHECKPOINT))


def test_what_is_no_policy_to_begin_with_is_refused_before_anything_is_written(tmp_path, capsys):
    text = tmp_path / "notes.md"
    text.write_text("not a checkpoint")
    for path, reason in ((text, "not a checkpoint"), (tmp_path / "nowhere", "no such training")):
        out = tmp_path / "out"
        command = ["train", str(tmp_path / "demo.h5"), "--model", str(tmp_path / "model.toml"), "--out", str(out)]
        assert main([*command, "--begin-with", str(path)]) != 0
        assert reason in capsys.readouterr().err
        assert not out.exists()


def test_first_diverged_state_is_saved(made, tmp_path, monkeypatch):
    step = Environment.step

    def kicked(self, actions):
        self.physics.qvel[1, 0] = 1e9
        return step(self, actions)

    monkeypatch.setattr(Environment, "step", kicked)
    _, last = train_run(made, tmp_path, device="cpu")
    assert last is not None
    assert last.log["diverged worlds"] > 0
    assert (tmp_path / DIVERGED_STATE_FILE).is_file()


def test_interval_is_wilsons():
    assert wilson(0, 0) == (0.0, 1.0)
    assert wilson(10, 10)[1] == pytest.approx(1.0)
    assert wilson(10, 10)[0] == pytest.approx(0.7225, abs=1e-4)
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)


def test_commands_train_and_evaluate(made, tmp_path, capsys):
    write_hdf5(made.recording, tmp_path / "demo.h5")
    made.model.save(tmp_path / "model.toml")
    made.events.save(tmp_path / "events.json")
    options = f"--model {tmp_path}/model.toml --events {tmp_path}/events.json --out {tmp_path}/run --device cpu"
    options += " --worlds 4 --iterations 2 --ppo.steps 4 --ppo.hidden 16 --environment.reset.states 8"
    options += " --environment.reset.turn 0 --environment.action.gripper-actuators grip --environment.episode 0.5"
    assert main(["train", f"{tmp_path}/demo.h5", *options.split(), "--reward", "engineered"]) == 0
    cfg = TrainCfg.load(tmp_path / "run" / "train.toml")
    assert cfg.environment.reward.kind == "engineered"
    assert cfg.environment.worlds == 4
    capsys.readouterr()
    assert main(["evaluate", "--checkpoint", f"{tmp_path}/run", "--episodes", "4", "--device", "cpu"]) == 0
    said = capsys.readouterr().out
    assert "simulation: " in said
    assert "reality: " in said
    assert "of 4 succeed" in said
    assert main(["evaluate", "--checkpoint", f"{tmp_path}/nothing"]) == 2
    capsys.readouterr()
    hidden = ["--hide", "joint_friction=2", "mass=1.5", "--json"]
    assert main(["evaluate", "--checkpoint", f"{tmp_path}/run", "--episodes", "4", "--world", "reality", *hidden]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["hidden"] == {"joint_friction": 2.0, "mass": 1.5}
    assert document["worlds"]["reality"]["episodes"] == len(document["worlds"]["reality"]["outcomes"]) == 4


def test_commands_train_and_evaluate_a_chain(made, tmp_path, capsys):
    write_hdf5(made.recording, tmp_path / "demo.h5")
    made.model.save(tmp_path / "model.toml")
    made.events.save(tmp_path / "events.json")
    options = f"--model {tmp_path}/model.toml --events {tmp_path}/events.json --out {tmp_path}/run --device cpu"
    options += " --stage all --worlds 4 --iterations 2 --ppo.steps 4 --ppo.hidden 16 --environment.reset.states 8"
    options += " --environment.reset.turn 0 --environment.reset.heading 0 0 --environment.reset.place 0.02 0.01"
    options += " --environment.action.gripper-actuators grip --environment.episode 0.3"
    assert main(["train", f"{tmp_path}/demo.h5", *options.split()]) == 0
    assert main(["train", f"{tmp_path}/demo.h5", *options.split(), "--resume", "--iterations", "3"]) == 0
    capsys.readouterr()
    command = ["evaluate", "--checkpoint", f"{tmp_path}/run", "--episodes", "3", "--device", "cpu"]
    assert main([*command, "--world", "simulation"]) == 0
    assert "targets met in order: pick 0.0%, align 0.0%, insert 0.0%" in capsys.readouterr().out
    assert main([*command, "--videos", "1", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    for world in ("simulation", "reality"):
        met = document["worlds"][world]["stages met"]
        assert met == [{"stage": name, "episodes": 0} for name in ("pick", "align", "insert")]
    assert len(list((tmp_path / "run" / "videos").iterdir())) == 1
    described = Policy.load(tmp_path / "run").export(tmp_path / "policy.pt")
    assert described["stages"] == ["pick", "align", "insert"]
    assert described["moving on"]["hold"] == 2
    assert [p["stage"] for p in described["observation"]["slots"]["pairs"]].count("align") == 8


def test_first_episodes_in_reality_are_filmed(made, tmp_path, capsys):
    import cv2

    episode = replace(made, cfg=replace(made.cfg, environment=replace(made.cfg.environment, episode=0.4)))
    train_run(episode, tmp_path / "run", device="cpu")
    command = ["evaluate", "--checkpoint", f"{tmp_path}/run", "--episodes", "3", "--world", "reality", "--videos", "2"]
    command += ["--hide", "mass=1.5"]
    assert main(command) == 0
    files = sorted((tmp_path / "run" / "videos").iterdir())
    assert [file.name for file in files] == ["reality_mass=1.5_000.mp4", "reality_mass=1.5_001.mp4"]
    assert files[1].name in capsys.readouterr().out
    video = cv2.VideoCapture(str(files[0]))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(20)
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    assert 1 <= len(frames) <= 8
    assert frames[0].shape == (240, 320, 3)
    assert frames[0].std() > 10
    assert main(command) == 2
    assert "overwrite" in capsys.readouterr().err
    assert main([*command, "--videos", "9"]) == 2
    assert "number of videos" in capsys.readouterr().err
