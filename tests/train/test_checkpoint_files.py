"""Checkpoints are read as data: nothing in them runs, and what is no policy is refused in one sentence."""

import os
import zipfile
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from data_parallel_training import make_run

from concent_warp.checkpoint_file import read_checkpoint, write_checkpoint
from concent_warp.cli import main
from concent_warp.errors import ConcentError, RenderError, TrainError
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.render.networks.painter import Painter
from concent_warp.train.learning.ppo import CHECKPOINT, load_checkpoint
from concent_warp.train.policy.load import Policy
from concent_warp.train.run import TrainingRun, train_run

ACTOR = "actor_state_dict"


class Code:
    """An object whose pickle makes a file when it is loaded."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a short training that the command line made, with its inputs beside it."""
    folder, run = tmp_path_factory.mktemp("trained"), make_run()
    write_hdf5(run.recording, folder / "demo.h5")
    run.model.save(folder / "model.toml")
    run.events.save(folder / "events.json")
    assert main(training(folder)) == 0
    return folder


def training(folder: Path, *more: str) -> list[str]:
    options = f"{folder}/demo.h5 --model {folder}/model.toml --events {folder}/events.json --out {folder}/run"
    options += " --device cpu --worlds 4 --iterations 1 --ppo.steps 4 --ppo.hidden 16 --environment.reset.states 8"
    options += " --environment.reset.turn 0 --environment.action.gripper-actuators grip --environment.episode 0.5"
    options += " --environment.edges.count 0 --environment.virtual.points 0 --stress.every 0"
    return ["train", *options.split(), *more]


def copied(trained: Path, tmp_path: Path) -> Path:
    """Return a copy of the training's folder and of its inputs."""
    for path in trained.rglob("*"):
        if path.is_file():
            to = tmp_path / path.relative_to(trained)
            to.parent.mkdir(parents=True, exist_ok=True)
            to.write_bytes(path.read_bytes())
    return tmp_path / "run"


def changed(path: Path, change) -> None:
    """Change the content of a checkpoint."""
    document = torch.load(path, weights_only=True)
    change(document)
    torch.save(document, path)


COMMANDS = {
    "export": ["export", "--checkpoint", "{run}", "--out", "{folder}/policy.onnx"],
    "evaluate": ["evaluate", "--checkpoint", "{run}", "--episodes", "2", "--device", "cpu"],
    "play": ["play", "--checkpoint", "{run}", "--episodes", "1"],
    "render": ["render", "--checkpoint", "{run}", "--out", "{folder}/dataset"],
}


def called(command: str, run: Path) -> int:
    folder = run.parent
    if command == "begin-with":
        (folder / "new").mkdir()
        for path in folder.iterdir():
            if path.is_file():
                (folder / "new" / path.name).write_bytes(path.read_bytes())
        return main(training(folder / "new", "--begin-with", str(run)))
    if command == "resume":
        return main(training(folder, "--resume", "--iterations", "2"))
    return main([part.format(run=run, folder=folder) for part in COMMANDS[command]])


commands = pytest.mark.parametrize("command", [*COMMANDS, "begin-with", "resume"])


@pytest.mark.parametrize(
    ("command", "place"),
    [
        *((command, "weights") for command in (*COMMANDS, "begin-with", "resume")),
        *(("evaluate", place) for place in ("whole", "optimiser", "beside")),
        ("resume", "beside"),
    ],
)
def test_code_in_a_checkpoint_does_not_run(trained, tmp_path, capsys, command, place):
    run, mark = copied(trained, tmp_path), tmp_path / "mark"

    def poison(document):
        if place == "whole":
            document.clear()
            document["code"] = Code(mark)
        elif place == "weights":
            document[ACTOR]["mlp.0.weight"] = Code(mark)
        elif place == "optimiser":
            document["optimizer_state_dict"] = Code(mark)
        else:
            document["note"] = [Code(mark)]

    changed(run / CHECKPOINT, poison)
    capsys.readouterr()
    assert called(command, run) == 2
    assert not mark.exists()
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "not a checkpoint of tensors and plain data, so it is not read" in said
    assert "a call of posix.mkdir" in said


@commands
def test_weights_that_are_not_finite_are_refused_by_name(trained, tmp_path, capsys, command):
    run = copied(trained, tmp_path)

    def spoil(document):
        document[ACTOR]["mlp.2.bias"][1] = float("nan")

    changed(run / CHECKPOINT, spoil)
    assert called(command, run) == 2
    assert f"{ACTOR}/mlp.2.bias is not finite; found 1 of its 4 numbers" in capsys.readouterr().err


@commands
def test_weights_of_another_shape_are_reported_in_one_sentence(trained, tmp_path, capsys, command):
    run = copied(trained, tmp_path)

    def narrow(document):
        document[ACTOR]["mlp.2.weight"] = document[ACTOR]["mlp.2.weight"][:, :5].clone()

    changed(run / CHECKPOINT, narrow)
    capsys.readouterr()
    assert called(command, run) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "another architecture; expected mlp.2.weight (4, 16) of real numbers, found mlp.2.weight (4, 5)" in said


def without(name):
    return lambda document: document[ACTOR].pop(name)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (without("mlp.0.weight"), "found mlp.0.weight none"),
        (lambda d: d[ACTOR].update(extra=torch.zeros(2)), "expected extra none"),
        (lambda d: d[ACTOR].update({"mlp.2.bias": 1.0}), "found mlp.2.bias no tensor"),
        (lambda d: d[ACTOR].update({"mlp.2.bias": torch.zeros(4, dtype=torch.int64)}), "of whole numbers"),
        (lambda d: d.update({ACTOR: [1]}), "has no state; found list"),
        (lambda d: d[ACTOR].update({"mlp.2.bias": torch.zeros(1).expand(10**12)}), "elements that are not stored"),
        (lambda d: d[ACTOR].update({"mlp.2.bias": torch.zeros(4).to_sparse()}), "elements that are not stored"),
        (lambda d: d.update(iteration=-1), "iteration of the checkpoint is no count"),
        (lambda d: d.update(steps="many"), "steps of the checkpoint is no count"),
        (lambda d: d.update(seconds=float("nan")), "seconds is not finite"),
        (lambda d: d.pop("seconds"), "not a checkpoint of this kind"),
    ],
)
def test_policies_of_other_kinds_are_refused(trained, tmp_path, capsys, change, reason):
    run = copied(trained, tmp_path)
    changed(run / CHECKPOINT, change)
    assert called("evaluate", run) == 2
    assert reason in capsys.readouterr().err


def rank(document):
    return document["ranks"][0]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda d: d.pop("ranks"), "no training to resume"),
        (lambda d: d.update(ranks=3), "another number of processes"),
        (lambda d: d.update(ranks=[3]), "no training like this one"),
        (lambda d: d["ranks"].append(rank(d)), "another number of processes"),
        (lambda d: d.pop("critic_state_dict"), "critic has no state"),
        (lambda d: d.pop("optimizer_state_dict"), "no training like this one"),
        (lambda d: d["optimizer_state_dict"]["param_groups"].clear(), "no training like this one"),
        (lambda d: d["optimizer_state_dict"]["state"][0].update(exp_avg=torch.zeros(3)), "exp_avg of shape (3,)"),
        (lambda d: d.update(learning_rate=float("inf")), "learning_rate is not finite"),
        (lambda d: d.pop("learning_rate"), "no training like this one"),
        (lambda d: rank(d)["environment"].pop("qpos"), "lacks a part of the environment"),
        (lambda d: rank(d)["environment"].update(qpos=torch.zeros(4, 1)), "expected qpos (4, 12)"),
        (lambda d: rank(d)["random"].update(cpu=torch.zeros(3, dtype=torch.uint8)), "no training like this one"),
    ],
)
def test_trainings_of_other_kinds_are_not_resumed(trained, tmp_path, capsys, change, reason):
    run = copied(trained, tmp_path)
    changed(run / CHECKPOINT, change)
    before = (run / CHECKPOINT).read_bytes()
    assert called("resume", run) == 2
    assert reason in capsys.readouterr().err
    assert (run / CHECKPOINT).read_bytes() == before


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def bomb(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", b"0" * 2_000_000)


def deep(path: Path) -> None:
    value: object = 1
    for _ in range(30):
        value = [value]
    changed(path, lambda document: document.update(note=value))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (pipe, "no such checkpoint"),
        (lambda path: path.write_bytes(b""), "not a checkpoint"),
        (lambda path: path.write_bytes(b"\x80\x04cposix\nmkdir\n."), "not a checkpoint"),
        (lambda path: path.write_bytes(path.read_bytes()[:-100]), "not a checkpoint"),
        (bomb, "too large"),
        (deep, "nested too deeply"),
        (lambda path: torch.save([1], path), "not a checkpoint of this kind"),
    ],
)
def test_files_that_are_no_checkpoints_are_refused(trained, tmp_path, monkeypatch, spoil, reason):
    path = copied(trained, tmp_path) / CHECKPOINT
    monkeypatch.setenv("CONCENT_MAX_CHECKPOINT_BYTES", "1000000")
    load_checkpoint(path)
    spoil(path)
    with pytest.raises(TrainError, match=reason):
        load_checkpoint(path)


def test_an_exported_policy_is_no_checkpoint(trained, tmp_path):
    Policy.load(trained / "run").export(tmp_path / "policy.pt")
    with pytest.raises(TrainError, match="not a checkpoint"):
        load_checkpoint(tmp_path / "policy.pt")


def test_what_was_written_is_read(tmp_path):
    document = {"a": [torch.arange(3), {"b": (1, 2.5, "text", None, True)}], "c": OrderedDict(d=torch.eye(2)[:, :1])}
    write_checkpoint(tmp_path / "a.pt", document)
    found = read_checkpoint(tmp_path / "a.pt")
    assert torch.equal(found["a"][0], torch.arange(3))
    assert found["a"][1] == document["a"][1]
    assert torch.equal(found["c"]["d"], document["c"]["d"])
    with pytest.raises(ConcentError, match="no such checkpoint"):
        read_checkpoint(tmp_path)


def test_networks_are_read_as_data_too(tmp_path):
    path = tmp_path / CHECKPOINT
    torch.save({"trainings": {}, "cfg": {}, "cameras": [Code(tmp_path / "mark")], "references": []}, path)
    with pytest.raises(RenderError, match=r"so it is not read; found a call of posix\.mkdir"):
        Painter.load(tmp_path)
    assert not (tmp_path / "mark").exists()
    sizes = {"network": {"width": 10**6}, "super_resolution": {}}
    camera = {"name": "base", "body": None, "position": (0, 0, 0), "quaternion": (1, 0, 0, 0), "fovy": 45.0}
    for content, reason in (
        ({"cameras": [], "cfg": {}}, "cannot be read"),
        ({"cameras": [{}], "cfg": sizes}, "cannot be read"),
        ({"cameras": [camera], "cfg": sizes, "trainings": {"base": {"mean": {}}}}, "another architecture"),
        ({"cameras": [], "cfg": {}, "trainings": {"base": torch.tensor([torch.inf])}}, "trainings/base is not finite"),
    ):
        torch.save({"trainings": {}, "references": [torch.zeros(3, 64, 64)] * len(content["cameras"]), **content}, path)
        with pytest.raises(RenderError, match=reason):
            Painter.load(tmp_path)


def test_policy_begins_with_the_file_that_was_named(trained, tmp_path):
    run = copied(trained, tmp_path)
    (run / "best.pt").write_bytes((run / CHECKPOINT).read_bytes())
    changed(run / CHECKPOINT, lambda document: document[ACTOR]["mlp.0.bias"].fill_(9.0))
    policy = Policy.load(run / "best.pt")
    made = TrainingRun.load(run)
    hardly = replace(made.cfg.ppo, iterations=1, learning_rate=1e-12, schedule="fixed")
    trainer, _ = train_run(
        replace(made, cfg=replace(made.cfg, ppo=hardly)), None, device="cpu", begin_with=policy.weights
    )
    found = dict(trainer.algorithm.actor.named_parameters())["mlp.0.bias"]
    assert torch.allclose(found, policy.weights[ACTOR]["mlp.0.bias"], rtol=0, atol=1e-9)


@pytest.mark.parametrize("command", ["export", "evaluate"])
def test_a_flipped_bit_in_the_weights_is_refused(trained, tmp_path, capsys, command):
    run = copied(trained, tmp_path)
    content = bytearray((run / CHECKPOINT).read_bytes())
    weight = torch.load(run / CHECKPOINT, weights_only=True)[ACTOR]["mlp.0.weight"].numpy().tobytes()
    content[content.index(weight)] ^= 1
    (run / CHECKPOINT).write_bytes(content)
    assert called(command, run) == 2
    assert "the checkpoint is damaged; found another checksum of" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("*", "", "the configuration of a training is empty"),
        ('activation = "swish"', 'activation = "wish"', "activation"),
    ],
)
def test_damaged_settings_of_a_training_are_refused(trained, tmp_path, capsys, old, new, message):
    run = copied(trained, tmp_path)
    text = (run / "train.toml").read_text()
    (run / "train.toml").write_text("" if old == "*" else text.replace(old, new))
    assert called("export", run) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"demonstration": "demo_9"}, "the contact events are of another demonstration; expected demo_0, found demo_9"),
        ({"body": "brick"}, "which the model does not have; found body brick"),
        ({"sphere": -1}, "which the model does not have; found body .*, sphere -1"),
        ({"sphere": 10**9}, "which the model does not have; found body .*, sphere 1000000000"),
    ],
)
def test_events_of_something_else_are_refused(change, message):
    run = make_run()
    if "demonstration" in change:
        events = replace(run.events, **change)
    else:
        number = next(k for k, entity in enumerate(run.events.entities) if entity.sphere is not None)
        entities = list(run.events.entities)
        entities[number] = replace(entities[number], **change)
        events = replace(run.events, entities=tuple(entities))
    with pytest.raises(ConcentError, match=message):
        TrainingRun(run.model, run.recording, events, run.cfg)
