"""Checkpoints and run folders of trainings that are broken, for all commands that read them."""

from __future__ import annotations

import os
import pickle
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.bad_input.case import Case, Code, flip_byte, replace_text, truncate, write

FOLDER, CHECKPOINT, SETTINGS = "policy", "policy/checkpoint.pt", "policy/train.toml"
ACTOR = "actor_state_dict"
READERS = {
    "export": "export --checkpoint {} -o out.onnx",
    "evaluate": "evaluate --checkpoint {} --episodes 1 --world reality --device cpu",
    "play": "play --checkpoint {} --episodes 1 --port 0",
    "render": "render --checkpoint {} -o out --device cpu --episodes 1",
    "train": "train policy/demonstration.h5 --model policy/model.toml --events policy/events.json --device cpu "
    "--worlds 2 --environment.reset.states 8 --begin-with {} -o out",
}
"""Command lines that read a policy."""


def edited(edit: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    """Return a change of the document in the checkpoint."""

    def change(folder: Path) -> None:
        import torch

        document = torch.load(folder / CHECKPOINT, weights_only=True)
        edit(document)
        torch.save(document, folder / CHECKPOINT)

    return change


def first_weight(document: dict[str, Any]) -> str:
    """Return the name of a matrix of the policy's network."""
    return next(name for name, value in document[ACTOR].items() if name.endswith("weight") and value.ndim == 2)


def weight(make: Callable[[Any], Any]) -> Callable[[Path], None]:
    """Return a change of one matrix of the policy's network."""

    def edit(document: dict[str, Any]) -> None:
        name = first_weight(document)
        document[ACTOR][name] = make(document[ACTOR][name])

    return edited(edit)


def nested(levels: int) -> Any:
    """Return lists within one another."""
    value: Any = 1
    for _ in range(levels):
        value = [value]
    return value


def checkpoints() -> Iterator[tuple[str, Callable[[Path], object]]]:
    """Yield broken checkpoints."""
    import torch

    def saved(value: Any) -> Callable[[Path], None]:
        return lambda folder: torch.save(value, folder / CHECKPOINT)

    def archive(folder: Path) -> None:
        with zipfile.ZipFile(folder / CHECKPOINT, "w") as file:
            file.writestr("readme", "no checkpoint")

    def bomb(folder: Path) -> None:
        with zipfile.ZipFile(folder / CHECKPOINT, "w", zipfile.ZIP_DEFLATED) as file:
            file.writestr("checkpoint/data/0", b"zeros")
            file.infolist()[0].file_size = 5 << 30

    yield "code in place of a checkpoint", saved(Code())
    yield "code beside the weights", edited(lambda document: document.__setitem__("note", [Code()]))
    yield "code in place of a weight", weight(lambda _: Code())
    yield "a bare pickle of code", write(CHECKPOINT, pickle.dumps(Code()))
    yield "an empty file", write(CHECKPOINT, "")
    yield "text", write(CHECKPOINT, "weights")
    yield "an archive of something else", archive
    yield "an archive that is to unpack to 5 GiB", bomb
    yield "a list", saved([1, 2, 3])
    yield "a tensor", saved(torch.zeros(3))
    yield "no parts", saved({})
    yield "no network", edited(lambda document: document.pop(ACTOR))
    yield "a network that is a list", edited(lambda document: document.__setitem__(ACTOR, [1.0]))
    yield "a network without weights", edited(lambda document: document.__setitem__(ACTOR, {}))
    yield "a weight NaN", weight(lambda value: value * float("nan"))
    yield "one weight infinite", weight(lambda value: value.index_fill(0, torch.tensor([0]), float("inf")))
    yield "a weight of another shape", weight(lambda value: value[:, :5].clone())
    yield "a weight of whole numbers", weight(lambda value: value.long())
    yield "a weight of complex numbers", weight(lambda value: value + 1j)
    yield "a weight that is text", weight(lambda _: "heavy")
    yield "a weight of 10^12 numbers, one stored", weight(lambda _: torch.zeros(1).expand(10**6, 10**6))
    yield "a sparse weight", weight(lambda value: value.to_sparse())
    yield "a weight too many", edited(lambda document: document[ACTOR].__setitem__("more", torch.zeros(3)))
    yield "a weight too few", edited(lambda document: document[ACTOR].pop(first_weight(document)))
    yield "200 levels", saved({"a": nested(200)})
    yield "25 levels", edited(lambda document: document.__setitem__("note", nested(25)))
    for share in (0.1, 0.5, 0.99):
        yield f"truncated to {share:.0%}", truncate(CHECKPOINT, share)
    yield "a byte flipped in the directory", flip_byte(CHECKPOINT, 0.999)
    yield "a byte flipped in the weights", flip_byte(CHECKPOINT, 0.5)


def folders() -> Iterator[tuple[str, Callable[[Path], object]]]:
    """Yield broken run folders."""
    yield "no checkpoint", lambda folder: (folder / CHECKPOINT).unlink()
    yield "checkpoint a folder", lambda folder: ((folder / CHECKPOINT).unlink(), (folder / CHECKPOINT).mkdir())
    yield "checkpoint a pipe", lambda folder: ((folder / CHECKPOINT).unlink(), os.mkfifo(folder / CHECKPOINT))
    yield "checkpoint /dev/zero", lambda folder: (
        (folder / CHECKPOINT).unlink(), (folder / CHECKPOINT).symlink_to("/dev/zero")
    )  # fmt: skip
    yield "no settings", lambda folder: (folder / SETTINGS).unlink()
    yield "settings empty", write(SETTINGS, "")
    yield "settings of 100,000 brackets", write(SETTINGS, "a = " + "[" * 100_000)
    replaced = {
        "an unknown setting": ("checkpoint = 25", "chekpoint = 25"),
        "worlds of text": ("worlds = 4096", 'worlds = "many"'),
        "worlds -1": ("worlds = 4096", "worlds = -1"),
        "worlds of 400 digits": ("worlds = 4096", f"worlds = {'4' * 400}"),
        "a seed of -1": ("seed = 12", "seed = -1"),
        "an unknown stage": ('stage = "insert"', 'stage = "dance"'),
        "an unknown gripper": ('"gripper",', '"hand",'),
        "an unknown tool site": ('tool_site = "tcp"', 'tool_site = "tool"'),
        "discount NaN": ("discount = 0.98", "discount = nan"),
        "discount 2": ("discount = 0.98", "discount = 2.0"),
        "decimation 0": ("decimation = 10", "decimation = 0"),
        "an unknown activation": ('"swish"', '"wish"'),
        "hidden layers of -1": ("256,\n    256,\n    256", "-1"),
        "no hidden layers": ("    256,\n    256,\n    256,\n", ""),
        "other hidden layers": ("256,\n    256,\n    256", "64"),
        "slots -8": ("slots = 8", "slots = -8"),
        "slots 3": ("slots = 8", "slots = 3"),
        "an environment that is a number": ("[environment]\n", "[rest]\n"),
        "action steps infinite": ("turn = 0.006", "turn = inf"),
        "place of one number": ("    0.05,\n    0.03,\n", "    0.05,\n"),
    }
    for name, (old, new) in replaced.items():
        yield name, replace_text(SETTINGS, old, new)
    for file in ("demonstration.h5", "model.toml", "events.json", "model.geometry.npz", "model.scene.xml"):
        yield f"no {file}", lambda folder, file=file: (folder / FOLDER / file).unlink()
    yield "a demonstration cut", truncate("policy/demonstration.h5")
    yield "events cut", truncate("policy/events.json")
    yield "another demonstration", lambda folder: (folder / "recording.h5").rename(folder / "policy/demonstration.h5")


def cases() -> Iterator[Case]:
    """Yield broken policies."""
    names = list(READERS)
    for number, (name, change) in enumerate([*checkpoints(), *folders()]):
        for command in dict.fromkeys([names[number % len(names)], names[(2 * number + 1) % len(names)]]):
            if command == "train" and number >= len(list(checkpoints())):
                command = "export"  # a training begins with the weights alone
            yield Case("policies", name, READERS[command].format(FOLDER), change, policy=True)
