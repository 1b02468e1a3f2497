"""Recordings as CSV folders, servo logs and tosses that are broken in one place each."""

from __future__ import annotations

import json
import os
import pickle
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bad_input.case import READERS, Case, Code, Rotation, crossed, several, write
from benchmarks.bad_input.sound_inputs import ANGLE, TIME, csv_text, servo_log, toss_rows

Input = tuple[str, str, Callable[[Path], object]]
ANGLES, PLACE, TURN = (
    f"csv/{name}.csv" for name in ("measured_elbow_angle", "measured_block_position", "measured_block_orientation")
)
COMMAND = "csv/action_elbow.csv"


def csv_inputs() -> Iterator[Input]:
    """Yield broken CSV folders."""
    still = np.ones((len(TIME), 1))
    texts = {
        "text in a cell": (ANGLES, "time,angle\n0,0.1\n0.01,open\n"),
        "no header": (ANGLES, "0,0.1\n0.01,0.2\n"),
        "no time": (ANGLES, "angle,speed\n0.1,0\n"),
        "a ragged row": (ANGLES, "time,angle\n0,0.1\n0.01,0.2,0.3\n"),
        "a short row": (PLACE, "time,x,y,z\n0,0.4,0,0.02\n0.01,0.4,0\n"),
        "semicolons and commas": (ANGLES, "time;angle\n0;0,1\n"),
        "decimal commas": (ANGLES, 'time,angle\n0,"0,1"\n0.01,"0,2"\n'),
        "header alone": (ANGLES, "time,angle\n"),
        "an empty file": (ANGLES, ""),
        "a clock up to 1e9 s": (ANGLES, "time,angle\n0,0.1\n1e9,0.2\n"),
        "a command at 5e4 s": (COMMAND, "time,command\n0,0.1\n5e4,0.2\n"),
        "times 1e400": (ANGLES, "time,angle\n0,0.1\n1e400,0.2\n"),
        "times backwards": (ANGLES, "time,angle\n0,0.1\n0.02,0.2\n0.01,0.2\n"),
        "a time twice": (ANGLES, "time,angle\n0,0.1\n0.01,0.2\n0.01,0.2\n"),
        "times missing": (ANGLES, "time,angle\n0,0.1\n,0.2\n"),
        "infinite values": (ANGLES, "time,angle\n0,inf\n0.01,-inf\n"),
        "only missing values": (ANGLES, "time,angle\n0,\n0.01,\n"),
        "a number of 5,000 digits": (ANGLES, f"time,angle\n0,{'9' * 5000}\n0.01,0.2\n"),
        "a cell of 10 MB": (ANGLES, f"time,angle\n0,{'x' * 10_000_000}\n"),
        "a quotation without an end": (ANGLES, 'time,angle\n0,"0.1\n0.01,0.2\n'),
        "NUL bytes": (ANGLES, "time,angle\n0,0.1\x00\n0.01,0.2\n"),
        "degrees by name": (ANGLES, csv_text("time,angle_deg", ANGLE)),
        "millimetres by name": (PLACE, csv_text("time,x_mm,y_mm,z_mm", still * [0.4, 0, 0.02])),
        "a column called after an actuator": (ANGLES, csv_text("time,block_position", ANGLE)),
        "two columns of one name": (PLACE, csv_text("time,x,x,z", still * [0.4, 0, 0.02])),
        "position columns x, y, w": (PLACE, csv_text("time,x,y,w", still * [0.4, 0, 0.02])),
        "quaternion columns x, y, z alone": (TURN, csv_text("time,x,y,z", still * [0, 0, 0])),
        "quaternion columns w, x, y, y": (TURN, csv_text("time,qw,qx,qy,qy", still * [1, 0, 0, 0])),
        "quaternion columns a roll and pitch": (TURN, csv_text("time,roll,pitch,yaw", still * [0, 0, 0])),
        "values named z, x, y, w that are no unit quaternions": (TURN, csv_text("time,z,x,y,w", still * [1, 1, 0, 0])),
        "too many columns": (ANGLES, csv_text("time,a,b", still * [0.1, 0.2])),
        "two commands in a file": (COMMAND, csv_text("time,a,b", still * [0.1, 0.2])),
        "an unknown sensor": ("csv/measured_knee.csv", csv_text("time,angle", ANGLE)),
        "an unknown actuator": ("csv/action_knee.csv", csv_text("time,angle", ANGLE)),
        "a file of an unknown name": ("csv/elbow.csv", csv_text("time,angle", ANGLE)),
        "initial state of a wrong size": ("csv/initial.csv", "qpos,0,0\nqvel,0\n"),
        "initial state of text": ("csv/initial.csv", "qpos,zero\nqvel,0\n"),
        "initial state without qpos": ("csv/initial.csv", "velocity,0\n"),
        "demonstrations beside files": ("csv/demo_1/measured_elbow_angle.csv", csv_text("time,angle", ANGLE)),
    }
    for name, (file, text) in texts.items():
        yield f"CSV: {name}", "csv", write(file, text)
    yield "CSV: not UTF-8", "csv", write(ANGLES, b"time,angle\n0,\xff\xfe\n")
    yield "CSV: UTF-16", "csv", write(ANGLES, "time,angle\n0,0.1\n".encode("utf-16"))
    yield "CSV: no scene", "csv", lambda folder: (folder / "csv/scene.xml").unlink()
    yield (
        "CSV: a scene that is a folder",
        "csv",
        several(lambda folder: (folder / "csv/scene.xml").unlink(), lambda folder: (folder / "csv/scene.xml").mkdir()),
    )
    yield "CSV: no CSV files", "csv", lambda folder: [path.unlink() for path in (folder / "csv").glob("*.csv")]
    for name, put in {
        "a pipe": os.mkfifo,
        "a link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
        "a link to nothing": lambda path: path.symlink_to("nothing"),
        "a folder": Path.mkdir,
        "a sparse file of 3 GB": lambda path: os.truncate(os.open(path, os.O_CREAT | os.O_WRONLY), 3 * 10**9),
    }.items():
        yield f"CSV: {name}", "csv", lambda folder, put=put: ((folder / ANGLES).unlink(), put(folder / ANGLES))


def servo_inputs() -> Iterator[Input]:
    """Yield broken servo logs."""

    def changed(**parts: Any) -> str:
        return json.dumps({**servo_log(), **parts})

    def entry(**parts: Any) -> str:
        log: Any = servo_log()
        log["entries"][30] |= parts
        return json.dumps(log)

    texts = {
        "no JSON": "a log",
        "a list": "[]",
        "100,000 brackets": "[" * 100_000,
        "a number of 5,000 digits": '{"mass": ' + "9" * 5000 + "}",
        "no entries": changed(entries=[]),
        "entries that are text": changed(entries="many"),
        "entries that are numbers": changed(entries=[1, 2, 3]),
        "negative mass": changed(mass=-1),
        "mass NaN": changed(mass=float("nan")),
        "mass 1e300": changed(mass=1e300),
        "length 0": changed(length=0),
        "length 1e300": changed(length=1e300),
        "gain that is true": changed(kp=True),
        "supply that is text": changed(vin="7.5"),
        "no set-up": json.dumps({"entries": servo_log()["entries"]}),
        "a time twice": entry(timestamp=0.29),
        "a time of 1e9 s": entry(timestamp=1e9),
        "a time that is infinite": entry(timestamp=float("inf")),
        "a position that is text": entry(position="1"),
        "a position of 1e300": entry(position=1e300),
        "no goal": entry(goal_position=None),
        "the motor off": json.dumps({**servo_log(), "entries": [{"torque_enable": False}] * 5}),
    }
    for name, text in texts.items():
        yield f"servo log: {name}", "servo.json", write("servo.json", text)
    yield "servo log: binary", "servo.json", write("servo.json", bytes(range(256)))
    yield "servo log: a pipe", "pipe.json", lambda folder: os.mkfifo(folder / "pipe.json")
    yield (
        "servo log: two set-ups in a folder",
        "logs",
        several(write("logs/a.json", changed()), write("logs/b.json", changed(mass=2.0))),
    )


def toss_inputs() -> Iterator[Input]:
    """Yield broken tosses."""
    import torch

    def saved(value: Any) -> Callable[[Path], None]:
        return lambda folder: torch.save(value, folder / "toss.pt")

    def archive(folder: Path) -> None:
        with zipfile.ZipFile(folder / "toss.pt", "w") as file:
            file.writestr("readme", "no tensor")

    def rows(row: int, column: int, value: float) -> Any:
        changed = toss_rows()
        changed[row:, column] = value
        return torch.from_numpy(changed)

    def truncated(folder: Path) -> None:
        (folder / "toss.pt").write_bytes((folder / "toss.pt").read_bytes()[:-900])

    changes: dict[str, Callable[[Path], object]] = {
        "pickle that names code": write("toss.pt", pickle.dumps(Code())),
        "pickle that names code, zipped": saved({"toss": Code()}),
        "wrong shape": saved(torch.zeros(50, 7)),
        "three dimensions": saved(torch.zeros(50, 13, 2)),
        "one row": saved(torch.zeros(1, 13)),
        "whole numbers": saved(torch.zeros(50, 13, dtype=torch.int64)),
        "complex numbers": saved(torch.zeros(50, 13, dtype=torch.complex64)),
        "a sparse tensor": saved(torch.zeros(50, 13).to_sparse()),
        "a list": saved([1, 2, 3]),
        "10^12 numbers": saved(torch.zeros(1, 13).expand(10**11, 13)),
        "truncated": truncated,
        "zip without a tensor": archive,
        "infinite positions": saved(rows(40, 4, np.inf)),
        "NaN everywhere": saved(rows(0, slice(None), np.nan)),  # type: ignore[arg-type]
        "quaternions of length 0": saved(rows(0, 0, 0)),
        "positions in millimetres": saved(torch.from_numpy(toss_rows() * ([1.0] * 4 + [1e3] * 3 + [1.0] * 6))),
        "empty": write("toss.pt", ""),
    }
    for name, change in changes.items():
        yield f"toss: {name}", "toss.pt", change
    yield "toss: folder named .pt", "other.pt", lambda folder: (folder / "other.pt").mkdir()


def cases() -> Iterator[Case]:
    """Yield broken recordings of the other kinds for all commands that read one."""
    rotation = Rotation({name: line for name, line in READERS.items() if name != "geometry"})
    yield from crossed("recordings (CSV)", rotation, csv_inputs())
    names = ("compare", "diagnose", "locate", "fit", "replay", "events")
    rotation = Rotation({name: READERS[name] for name in names})
    yield from crossed("recordings (servo logs, tosses)", rotation, [*servo_inputs(), *toss_inputs()])
