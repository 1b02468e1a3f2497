"""Models (TOML and npz) and contact events (JSON) that are broken in one place each."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bad_input.case import (
    MODEL_READERS,
    Case,
    Code,
    Rotation,
    crossed,
    flip_byte,
    replace_text,
    truncate,
    write,
)

MODEL, SCENE, GEOMETRY, EVENTS = "model.toml", "model.scene.xml", "model.geometry.npz", "events.json"
EFFECT = '\n[[effect]]\nname = "{}"\ntarget = {}\nvalues = [{}]\nintervals = [{}]\n'
Change = Callable[[Path], object]


def replace_geometry(**arrays: object) -> Change:
    """Return a change that replaces arrays of the contact geometry; None removes one."""

    def change(folder: Path) -> None:
        with np.load(folder / GEOMETRY) as data:
            changed: dict[str, Any] = {**dict(data), **arrays}
        np.savez(folder / GEOMETRY, **{name: value for name, value in changed.items() if value is not None})

    return change


def declared(folder: Path) -> None:
    """Let the header of an array declare 10^12 numbers."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(folder / GEOMETRY, "w") as archive:
        for name in ("bodies", "body", "position", "radius", "mass", "friction"):
            archive.writestr(f"{name}.npy", header.getvalue())


def bomb(folder: Path) -> None:
    """Pack 600 MB of zeros."""
    np.savez_compressed(folder / GEOMETRY, **dict.fromkeys(
        ("bodies", "body", "position", "radius", "mass", "friction"), np.zeros(75_000_000, np.uint8)
    ))  # fmt: skip


def effect(name: str, target: str = '["elbow"]', values: str = "0.1", intervals: str = "[0.05, 0.2]") -> Change:
    """Return a change that appends an effect to the model."""

    def change(folder: Path) -> None:
        with (folder / MODEL).open("a") as file:
            file.write(EFFECT.format(name, target, values, intervals))

    return change


def documents() -> Iterator[tuple[str, Change]]:
    """Yield broken TOML files."""
    yield "missing file", lambda folder: (folder / MODEL).unlink()
    yield "a folder", lambda folder: ((folder / MODEL).unlink(), (folder / MODEL).mkdir())
    yield "a pipe", lambda folder: ((folder / MODEL).unlink(), os.mkfifo(folder / MODEL))
    yield "/dev/zero", lambda folder: ((folder / MODEL).unlink(), (folder / MODEL).symlink_to("/dev/zero"))
    yield "an empty file", write(MODEL, "")
    yield "binary", write(MODEL, bytes(range(256)))
    yield "100,000 brackets", write(MODEL, "a = " + "[" * 100_000)
    yield "100,000 braces", write(MODEL, "a = " + "{b = " * 100_000)
    replaced = {
        "broken TOML": ("[contact]", "[contact"),
        "wrong format": ("concent-model", "urdf"),
        "version of the future": ("version = 1", "version = 9"),
        "version -1": ("version = 1", "version = -1"),
        "version that is text": ("version = 1", 'version = "1"'),
        "version of 5,000 digits": ("version = 1", f"version = {'1' * 5000}"),
        "unknown key": ("version = 1", "version = 1\ncolour = 3"),
        "unknown key in [contact]": ("condim", "condym"),
        "contact that is a number": ("[contact]", "contact = 3\n[other]"),
        "condim 5": ("condim = 4", "condim = 5"),
        "condim 4.0": ("condim = 4", "condim = 4.0"),
        "condim true": ("condim = 4", "condim = true"),
        "condim of 400 digits": ("condim = 4", f"condim = {'4' * 400}"),
        "solref NaN": ("0.005", "nan"),
        "solref infinite": ("0.005", "inf"),
        "solref negative": ("0.005", "-0.005"),
        "solref of 400 digits": ("0.005", "5" * 400),
        "solimp of text": ("0.95", "'stiff'"),
        "solimp above 1": ("0.95", "1.5"),
        "solimp reversed": ("0.95", "0.5"),
        "solimp -inf": ("0.95", "-inf"),
        "geometry without a name": (f'geometry = "{GEOMETRY}"', "geometry = 3"),
        "geometry /dev/zero": (f'geometry = "{GEOMETRY}"', 'geometry = "/dev/zero"'),
        "geometry outside the folder": (f'geometry = "{GEOMETRY}"', 'geometry = "../../gone.npz"'),
        "scene without a name": (f'scene = "{SCENE}"', "scene = []"),
        "scene of an escape sequence": (f'scene = "{SCENE}"', 'scene = "\\u001b[31m.xml"'),
        "scene of the model itself": (f'scene = "{SCENE}"', 'scene = "model.toml"'),
    }
    for name, (old, new) in replaced.items():
        yield name, replace_text(MODEL, old, new)
    yield "scene missing", lambda folder: (folder / SCENE).unlink()
    yield "scene not XML", write(SCENE, "a robot")
    yield "scene of another robot", replace_text(SCENE, '"elbow"', '"knee"')


def effects() -> Iterator[tuple[str, Change]]:
    """Yield models with broken effects."""
    yield "unknown effect", effect("magic")
    yield "effect on an unknown joint", effect("joint_friction", '["knee"]')
    yield "effect without a target", effect("joint_friction", "[]")
    yield "effect of target text", effect("joint_friction", '"elbow"')
    yield "effect of two values", effect("joint_friction", values="0.1, 0.2", intervals="[0, 1], [0, 1]")
    yield "effect without values", effect("joint_friction", values="", intervals="")
    yield "effect NaN", effect("joint_friction", values="nan")
    yield "effect -1", effect("joint_friction", values="-1.0")
    yield "effect inf", effect("joint_friction", values="inf")
    yield "effect of 400 digits", effect("joint_friction", values="9" * 400)
    yield "interval reversed", effect("joint_friction", intervals="[0.2, 0.1]")
    yield "interval NaN", effect("joint_friction", intervals="[nan, 0.1]")
    yield "an effect twice", lambda folder: (effect("joint_friction")(folder), effect("joint_friction")(folder))
    yield "effect that is a number", replace_text(MODEL, "version = 1", "version = 1\neffect = 3")
    yield "effects that are numbers", replace_text(MODEL, "version = 1", "version = 1\neffect = [1, 2]")


def geometries() -> Iterator[tuple[str, Change]]:
    """Yield models with broken contact geometry."""
    yield "geometry missing", lambda folder: (folder / GEOMETRY).unlink()
    for share in (0.0, 0.5, 0.98):
        yield f"geometry truncated to {share:.0%}", truncate(GEOMETRY, share)
    yield "geometry with a flipped byte", flip_byte(GEOMETRY)
    yield "geometry that declares 10^12 numbers", declared
    yield "geometry bomb", bomb
    yield "geometry is an .npy", lambda folder: np.save((folder / GEOMETRY).open("wb"), np.zeros(3))
    two = np.zeros(2)
    arrays: dict[str, dict[str, object]] = {
        "a pickle in the geometry": {"radius": np.array([Code(), Code()], dtype=object)},
        "no spheres": {
            "body": np.zeros(0, int), "position": np.zeros((0, 3)),
            "radius": two[:0], "mass": two[:0], "friction": two[:0],
        },
        "no radii": {"radius": two[:0]},
        "radii missing": {"radius": None},
        "a negative radius": {"radius": np.array([0.01, -0.01])},
        "a radius of 1e300": {"radius": np.array([0.01, 1e300])},
        "a radius NaN": {"radius": np.array([0.01, np.nan])},
        "a negative mass": {"mass": np.array([0.03, -0.03])},
        "a mass inf": {"mass": np.array([0.03, np.inf])},
        "a negative friction": {"friction": np.array([0.5, -0.5])},
        "a friction NaN": {"friction": np.array([0.5, np.nan])},
        "positions of two columns": {"position": np.zeros((2, 2))},
        "positions NaN": {"position": np.full((2, 3), np.nan)},
        "positions of 1e300": {"position": np.full((2, 3), 1e300)},
        "positions complex": {"position": np.zeros((2, 3), complex)},
        "positions text": {"position": np.array([["a", "b", "c"]] * 2)},
        "times for radii": {"radius": np.array([1, 2], "datetime64[s]")},
        "a body that the scene lacks": {"bodies": np.array(["brick"])},
        "bodies of numbers": {"bodies": np.array([1.0])},
        "a body number 7": {"body": np.array([0, 7])},
        "a body number -1": {"body": np.array([0, -1])},
        "body numbers that are broken": {"body": np.array([0, 0.5])},
    }  # fmt: skip
    for name, changed in arrays.items():
        yield name, replace_geometry(**changed)


def sequences() -> Iterator[tuple[str, Change]]:
    """Yield broken contact events."""
    yield "missing file", lambda folder: (folder / EVENTS).unlink()
    yield "a pipe", lambda folder: ((folder / EVENTS).unlink(), os.mkfifo(folder / EVENTS))
    contents = {"empty": "", "a list": "[]", "a number": "3", "100,000 brackets": "[" * 100_000, "null": "null",
                "a number of 5,000 digits": '{"version": ' + "9" * 5000 + "}",
                "no more than a format": '{"format": "concent-events"}'}  # fmt: skip
    for name, content in contents.items():
        yield name, write(EVENTS, content)
    yield "truncated", truncate(EVENTS)
    replaced = {
        "wrong format": ('"concent-events"', '"events"'),
        "version 2": ('"version": 1', '"version": 2'),
        "time step 0": ('"timestep": 0.005', '"timestep": 0'),
        "time step NaN": ('"timestep": 0.005', '"timestep": NaN'),
        "time step -1": ('"timestep": 0.005', '"timestep": -1'),
        "time step of text": ('"timestep": 0.005', '"timestep": "fast"'),
        "negative steps": ('"steps": 1400', '"steps": -1'),
        "steps of text": ('"steps": 1400', '"steps": "many"'),
        "another demonstration": ('"demo_0"', '"demo_77"'),
        "an escape sequence": ('"demo_0"', '"\\u001b[31m"'),
        "an unknown role": ('"role": "object"', '"role": "hero"'),
        "spheres of text": ('"sphere": 102}', '"sphere": "0"}'),
        "sphere -1": ('"sphere": 102}', '"sphere": -1}'),
        "settings of a list": ('"settings": {', '"settings": [], "rest": {'),
        "an unknown setting": ('"max_gap"', '"max_gop"'),
        "a setting NaN": ('"max_gap": 0.05', '"max_gap": NaN'),
        "entities of a number": ('"entities": [', '"entities": 3, "rest": ['),
        "stages of a number": ('"stages": [', '"stages": 3, "rest": ['),
        "no stages": ('"stages": [', '"stages": [], "rest": ['),
        "unknown bodies": ('"body": "block"', '"body": "brick"'),
    }
    for name, (old, new) in replaced.items():
        yield name, replace_text(EVENTS, old, new)


def cases() -> Iterator[Case]:
    """Yield broken models and events."""
    broken = [(name, MODEL, change) for make in (documents, effects, geometries) for name, change in make()]
    yield from crossed("models", Rotation({**MODEL_READERS}), broken)
    policy = "policy/demonstration.h5 --model policy/model.toml --device cpu -o out"
    for name, change in sequences():
        yield Case("contact events", name, f"train {policy} --events {EVENTS}", change, policy=True)
