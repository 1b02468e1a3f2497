"""Sound but unusual inputs, which must be accepted."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from benchmarks.bad_input.case import Case, replace_text, several, write
from benchmarks.bad_input.scenes import with_body, with_top
from benchmarks.bad_input.sound_inputs import ANGLE, SCENE, TIME, csv_text
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.recording import Channel, Demonstration, Recording

AREA = "sound inputs"
DROP = np.arange(300) * 0.01
BALL = """<mujoco><worldbody><body name="ball" pos="0 0 47"><freejoint/><geom size="0.1"{}/></body></worldbody>
<sensor><framepos name="position" objtype="xbody" objname="ball"/></sensor></mujoco>"""


def falling(start: float = 47.0) -> np.ndarray:
    """Return positions of a ball that falls freely, shape (300, 3)."""
    return np.stack([0 * DROP, 0 * DROP, start - 9.81 * DROP**2 / 2], axis=1)


def drop(values: np.ndarray, geom: str = "") -> Callable[[Path], None]:
    """Return a change that writes a recording of a falling ball."""
    demonstration = Demonstration(
        name="demo_0",
        task="",
        qpos=np.array([0, 0, 47, 1, 0, 0, 0.0]),
        qvel=np.zeros(6),
        measured={"position": Channel(DROP, values)},
    )
    return lambda folder: write_hdf5(Recording(BALL.format(geom), (demonstration,)), folder / "drop.h5")


def attribute(entry: str, name: str, value: Any) -> Callable[[Path], None]:
    """Return a change of an attribute in the recording."""

    def change(folder: Path) -> None:
        with h5py.File(folder / "recording.h5", "r+") as file:
            file[entry].attrs[name] = value

    return change


def recordings() -> Iterator[tuple[str, str, Callable[[Path], object]]]:
    """Yield sound recordings: name, command line, build."""
    alone = falling() * [np.nan, np.nan, 1]
    missing = np.where(np.arange(900).reshape(300, 3) % 7, falling(), np.nan)
    for name, build in {
        "a ball that falls 47 m": drop(falling()),
        "height alone was measured": drop(alone),
        "components missing here and there": drop(missing),
        "a free body whose geoms do not collide": drop(falling(), ' contype="0" conaffinity="0"'),
    }.items():
        yield name, "compare drop.h5", build
        if name != "height alone was measured":
            yield name, "locate drop.h5", build
    free = drop(falling(), ' contype="0" conaffinity="0"')
    yield "a free body whose geoms do not collide", "diagnose drop.h5 --jobs 1 --effects air_drag", free
    still = np.ones((len(TIME), 1))
    turn, place = "csv/measured_block_orientation.csv", "csv/measured_block_position.csv"
    texts = {
        "quaternions as x, y, z, w": (turn, csv_text("time,x,y,z,w", still * [0, 0, 0, 1])),
        "quaternions as q0, q1, q2, q3": (turn, csv_text("time,q0,q1,q2,q3", still * [1, 0, 0, 0])),
        "positions as z, x, y": (place, csv_text("time,pos_z,pos_x,pos_y", still * [0.02, 0.4, 0])),
        "missing components": (place, "time,x,y,z\n0,0.4,,0.02\n0.01,,0,\n0.02,0.4,0,0.02\n"),
        "Windows line ends": (place, csv_text("time,x,y,z", still * [0.4, 0, 0.02]).replace("\n", "\r\n")),
        "a byte-order mark": (place, "\ufeff" + csv_text("time,x,y,z", still * [0.4, 0, 0.02])),
        "capitals and blanks in the header": (place, csv_text("Time, X, Y, Z", still * [0.4, 0, 0.02])),
        "an empty line at the end": (place, csv_text("time,x,y,z", still * [0.4, 0, 0.02]) + "\n"),
        "one row": ("csv/measured_elbow_angle.csv", "time,angle\n0,0\n"),
        "exponents": ("csv/measured_elbow_angle.csv", "time,angle\n0,1e-3\n1e-2,2E-3\n"),
        "a file of another kind beside": ("csv/notes.txt", "notes"),
        "a slower clock": (
            "csv/measured_elbow_angle.csv",
            csv_text("time,elbow", ANGLE).replace("\n0.01,", "\n0.0101,"),
        ),
    }
    for name, (file, text) in texts.items():
        yield f"CSV: {name}", "compare csv", write(file, text)
    yield "the CSV folder as it is", "compare csv", lambda _: None
    yield "the servo log as it is", "compare servo.json", lambda _: None
    yield "the toss as it is", "compare toss.pt", lambda _: None
    yield "an attribute of somebody else", "compare recording.h5", attribute("/", "lab", "ours")
    yield "accents in the task", "compare recording.h5", attribute("data/demo_0", "task", "pousser la pièce")
    yield "a long task", "compare recording.h5", attribute("data/demo_0", "task", "push " * 2000)


def scenes() -> Iterator[tuple[str, str, Callable[[Path], object]]]:
    """Yield sound scenes."""
    texts = {
        "a time step of 0.1 ms": with_top('<option timestep="0.0001"/>'),
        "a time step of 20 ms": with_top('<option timestep="0.02"/>'),
        "no gravity": with_top('<option gravity="0 0 0"/>'),
        "wind and a medium": with_top('<option density="1.2" viscosity="1.8e-5" wind="1 0 0"/>'),
        "elliptic cones, implicit": with_top('<option cone="elliptic" integrator="implicitfast"/>'),
        "accents in a name": SCENE.replace('name="arm"', 'name="bras_\u00e9"'),
        "blanks in a name": SCENE.replace('name="arm"', 'name="my arm"'),
        "a comment with dashes": with_top("<!-- - arm - -->"),
        "a texture of 512 x 512": with_top(
            '<asset><texture name="t" type="2d" builtin="checker" width="512" height="512"/></asset>'
        ),
        "100 bodies": with_body(
            '<replicate count="100" offset="0 0.2 0"><body pos="2 0 1"><joint type="slide"/><geom size="0.05"/></body>'
            "</replicate>"
        ),
        "bodies 60 deep": with_body(
            '<body pos="3 0 3">' + '<body pos="0 0.1 0"><joint damping="1"/><geom size=".01"/>' * 60 + "</body>" * 61
        ),
        "defaults": with_top('<default><geom friction="0.4"/><default class="a"/></default>'),
        "key frames": with_top("").replace(
            "</mujoco>", '<keyframe><key qpos="0 0.4 0 0.02 1 0 0 0"/></keyframe></mujoco>'
        ),
        "a tendon": with_top("").replace(
            "<actuator>", '<tendon><fixed name="f"><joint joint="elbow" coef="1"/></fixed></tendon><actuator>'
        ),
        "a memory of 200 MB": with_top('<size memory="200M"/>'),
    }  # fmt: skip
    for name, text in texts.items():
        yield name, "geometry unusual.xml -o out.toml --count 20", write("unusual.xml", text)
    include = several(
        write("part.xml", "<mujocoinclude><option timestep='0.002'/></mujocoinclude>"),
        write("unusual.xml", with_top('<include file="part.xml"/>')),
    )
    yield "an include beside it", "compare recording.h5 --model unusual.xml", include
    quad = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    mesh = with_top('<asset><mesh name="m" file="a.obj" scale="0.1 0.1 0.1"/></asset>').replace(
        "</worldbody>", '<body name="m" pos="2 0 1"><freejoint/><geom type="mesh" mesh="m"/></body></worldbody>'
    )
    yield (
        "a tetrahedron",
        "geometry unusual.xml -o out.toml --count 20",
        several(write("unusual.xml", mesh), write("a.obj", quad)),
    )


def models() -> Iterator[tuple[str, str, Callable[[Path], object]]]:
    """Yield sound models."""
    line = "compare recording.h5 --model model.toml"
    yield "the model as it is", line, lambda _: None
    yield "a comment in the model", line, replace_text("model.toml", "[contact]", "# soft\n[contact]")
    yield "solref of whole numbers", line, replace_text("model.toml", "condim = 4", "condim = 6")
    yield "a model without objects", "compare servo.json", lambda _: None
    yield "events of the model", "events policy/demonstration.h5 --model policy/model.toml -o out", lambda _: None
    yield "the policy as it is", "export --checkpoint policy -o out.onnx", lambda _: None
    yield "the policy's checkpoint file", "export --checkpoint policy/checkpoint.pt -o out.pt", lambda _: None
    yield "an effect that is added", "add joint_friction --model model.toml --target elbow -o out.toml", lambda _: None
    yield "help", "fit --help", lambda _: None
    yield "the version", "--version", lambda _: None
    yield "no arguments", "", lambda _: None


def cases() -> Iterator[Case]:
    """Yield sound inputs."""
    for make in (recordings, scenes, models):
        for name, line, build in make():
            yield Case(AREA, name, line, build, accepted=True, policy="policy" in line)
