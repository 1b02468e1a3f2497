"""Logs of other systems, their maps and calibrations, that are broken in one place each."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bad_input.case import Case, replace_text, truncate, write
from benchmarks.bad_input.sound_inputs import LOG_CAMERA, LOG_MAP

LINE = "import {} --model scene.xml --map map.toml -o out.h5"
AREA = "logs"


def camera(**changes: Any) -> Callable[[Path], None]:
    """Return a change of the intrinsics; None removes an entry."""
    entries = {name: value for name, value in {**LOG_CAMERA, **changes}.items() if value is not None}
    return write("log/intrinsics.json", json.dumps(entries))


def first_image(kind: str, image: np.ndarray | bytes) -> Callable[[Path], None]:
    """Return a change of the first image of a folder."""

    def change(folder: Path) -> None:
        import cv2

        path = min((folder / "log" / kind).iterdir())
        if isinstance(image, bytes):
            path.write_bytes(image)
        else:
            cv2.imwrite(str(path), image)

    return change


def maps() -> Iterator[tuple[str, str]]:
    """Yield broken maps: what is wrong, and the text."""
    changes = {
        "an unknown channel": ('"joints/angle"', '"joints/elbow"'),
        "an unknown sensor": ("measured.elbow_angle", "measured.knee_angle"),
        "an unknown actuator": ("action.elbow", "action.knee"),
        "an unknown unit": ('unit = "rad"', 'unit = "radians"'),
        "a unit of another kind": ('unit = "rad"', 'unit = "mm"'),
        "radians called degrees": ('"command/angle"', '"command/angle"\nscale = 57.29578'),
        "a wrong sign": ('unit = "rad"', "sign = -1"),
        "a sign of 2": ('unit = "rad"', "sign = 2"),
        "a scale of 0": ('unit = "rad"', "scale = 0"),
        "a scale of NaN": ('unit = "rad"', "scale = nan"),
        "a noise below 0": ('unit = "rad"', "noise_std = -1"),
        "an unknown setting": ('unit = "rad"', "units = 3"),
        "colours for depths": ('depth = "depth"', 'depth = "color"'),
        "an unknown camera's frames": ('color = "color"', 'color = "rgb"'),
        "an unknown body": ('depth = "depth"', 'depth = "depth"\nbody = "hand"'),
        "depths in metres": ('depth = "depth"', 'depth = "depth"\ndepth_unit = "m"'),
        "a pose of three rows": (", [0, 0, 0, 1]]", "]"),
        "a pose transposed": (
            "[[1, 0, 0, 0.4], [0, -1, 0, 0.6], [0, 0, -1, 0.5], [0, 0, 0, 1]]",
            "[[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0], [0.4, 0.6, 0.5, 1]]",
        ),
        "a pose mirrored": ("[[1, 0, 0, 0.4]", "[[-1, 0, 0, 0.4]"),
        "a channel of nobody's clock": ("[action", '[clock]\n"joints" = 1e4\n[action'),
        "a clock of an unknown unit": ("[action", '[clock]\n"joints" = { unit = "h" }\n[action'),
    }
    for name, (old, new) in changes.items():
        assert old in LOG_MAP, name
        yield name, LOG_MAP.replace(old, new)
    yield "no TOML", "[action"
    yield "nothing", ""
    yield "a list of numbers", "action = [1, 2]"
    yield "no commands", LOG_MAP.split("[action.elbow]")[0] + "[measured" + LOG_MAP.split("[measured")[1]


def cases() -> Iterator[Case]:
    """Yield broken logs, and sound ones."""
    for name, text in maps():
        yield Case(AREA, f"a map with {name}", LINE.format("log"), write("map.toml", text))
    changes: dict[str, Callable[[Path], object]] = {
        "no focal length": camera(fx=None),
        "a focal length of 0": camera(fx=0),
        "a focal length that is text": camera(fx="40"),
        "intrinsics of another size": camera(width=1280, height=720),
        "a fisheye lens": camera(model="kannala_brandt4", coeffs=[0.1, 0, 0, 0]),
        "three coefficients of the lens": camera(coeffs=[0.1, 0, 0]),
        "a depth scale of 0": camera(depth_scale=0),
        "intrinsics that are no JSON": write("log/intrinsics.json", "{"),
        "intrinsics that are a list": write("log/intrinsics.json", "[1]"),
        "no intrinsics": lambda folder: (folder / "log" / "intrinsics.json").unlink(),
        "depths in colours": first_image("depth", np.zeros((6, 8, 3), np.uint8)),
        "a depth of another size": first_image("depth", np.full((12, 16), 400, np.uint16)),
        "an image that is none": first_image("color", b"no image"),
        "an image without content": first_image("color", b""),
        "no colours": lambda folder: shutil.rmtree(folder / "log" / "color"),
        "no images": lambda folder: [shutil.rmtree(folder / "log" / kind) for kind in ("color", "depth")],
        "a table without times": write("log/joints.csv", "angle\n0\n"),
        "a table of text": write("log/joints.csv", "time,angle\n0,open\n"),
        "a table without rows": write("log/joints.csv", "time,angle\n"),
        "a ragged table": write("log/joints.csv", "time,angle\n0,1,2\n"),
        "a calibration that is none": write("log/calibration.json", "{}"),
        "a calibration without intrinsics": write("log/calibration.json", '{"cameras": {"wrist": {"body": "arm"}}}'),
        "a data set that is none": write("log/meta/info.json", "{}"),
        "a data set of version 2.1": write("log/meta/info.json", '{"codebase_version": "v2.1", "features": {}}'),
        "a data set without tables": write(
            "log/meta/info.json", '{"codebase_version": "v3.0", "fps": 3, "features": {}}'
        ),
        "a bag without content": write("log/metadata.yaml", ""),
    }
    for name, change in changes.items():
        yield Case(AREA, name, LINE.format("log"), change)
    for name, content in {"without content": b"", "of text": b"time,angle\n", "of zeros": bytes(4096)}.items():
        for suffix in ("mcap", "bag", "db3"):
            yield Case(AREA, f"a bag {name}", LINE.format(f"log.{suffix}"), write(f"log.{suffix}", content))
    yield Case(AREA, "a scene cut in half", LINE.format("log"), truncate("scene.xml"))
    actuator = replace_text(
        "scene.xml", '<position name="elbow"', '<motor name="other" joint="elbow"/><position name="elbow"'
    )
    yield Case(AREA, "an actuator without commands", LINE.format("log"), actuator)
    for given in ("gone", "csv", "recording.h5", "map.toml"):
        yield Case(AREA, f"{given} for a log", LINE.format(given))
    yield Case(AREA, "a log for a recording", "compare log")
    yield Case("sound inputs", "a folder of images", LINE.format("log"), accepted=True)
    yield Case(
        "sound inputs", "a map is proposed", "import log --model scene.xml --map new.toml --suggest", accepted=True
    )
    line = "import log --model scene.xml --map map.toml --dry-run"
    yield Case("sound inputs", "a dry run", line, accepted=True)
