"""MJCF scenes that are senseless, hostile or broken, for all commands that read one."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.bad_input.case import Case, Rotation, crossed, several, write
from benchmarks.bad_input.sound_inputs import SCENE

READERS = {
    "geometry": "geometry {} -o out.toml",
    "compare": "compare recording.h5 --model {}",
    "fit": "fit recording.h5 --scene {} -o out --fit.generations 1",
    "diagnose": "diagnose recording.h5 --model {} --jobs 1 -o out",
    "locate": "locate recording.h5 --model {}",
    "add": "add joint_friction --model {} --target elbow -o out.toml",
    "record": "record --robot {} -o out.h5",
}
"""Command lines that read a scene."""
FILE = "broken.xml"
BALL = '<body name="ball"><freejoint/><geom size="0.1"/></body>'
Input = tuple[str, str, Callable[[Path], object]]


def with_top(element: str) -> str:
    """Return the sound scene with an element at its top."""
    return SCENE.replace("<worldbody>", f"{element}<worldbody>", 1)


def with_body(element: str) -> str:
    """Return the sound scene with an element in its world."""
    return SCENE.replace("</worldbody>", f"{element}</worldbody>", 1)


def texts() -> Iterator[tuple[str, str]]:
    """Yield names and texts of scenes."""
    for value in ("-1", "0", "1e300", "1e-9", "nan", "inf", "1e400", "fast"):
        yield f"time step {value}", with_top(f'<option timestep="{value}"/>')
    yield "gravity NaN", with_top('<option gravity="0 0 nan"/>')
    yield "endless iterations", with_top('<option iterations="2000000000"/>')
    yield "an empty file", ""
    yield "no XML", "a robot"
    yield "another kind of XML", "<robot name='r'><link name='l'/></robot>"
    yield "no end", SCENE[: len(SCENE) // 2]
    yield "an unknown element", with_top("<robots/>")
    yield "an unknown attribute", SCENE.replace('kp="20"', 'kpp="20"')
    yield "an unknown joint in an actuator", SCENE.replace('joint="elbow" kp', 'joint="knee" kp')
    yield "two bodies of one name", with_body(BALL + BALL)
    yield "two joints of one name", with_body('<body><joint name="elbow"/><geom size=".1"/></body>')
    yield "two sensors of one name", SCENE.replace('"block_position"', '"elbow_angle"')
    yield "a moving body without mass", with_body("<body><joint/></body>")
    yield "a negative mass", with_body('<body><freejoint/><geom size="0.1" mass="-1"/></body>')
    yield "a negative size", with_body('<body><freejoint/><geom size="-0.1"/></body>')
    yield "damping NaN", with_body('<body><joint damping="nan"/><geom size="0.1"/></body>')
    yield "a stiffness of 5,000 digits", with_body(f'<body><joint stiffness="{"9" * 5000}"/><geom size="0.1"/></body>')
    yield "a range reversed", SCENE.replace("-170 170", "170 -170")
    yield "a free joint within a body", with_body(f"<body><geom size='.1'/>{BALL}</body>")
    yield (
        "an inertia that no body has",
        with_body('<body><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 100"/><geom size="0.1"/></body>'),
    )
    yield "3,000 bodies in one another", with_body("<body><geom size='.1'/>" * 3000 + "</body>" * 3000)
    yield "100,000 elements in one another", "<mujoco>" + "<a>" * 100_000
    yield "99,999 bodies", with_body(f'<replicate count="99999">{BALL}</replicate>')
    yield "10^10 bodies", with_body('<replicate count="99999"><replicate count="99999"/></replicate>')
    yield "a count that is negative", with_body(f'<replicate count="-5">{BALL}</replicate>')
    yield "a count that is text", with_body(f'<replicate count="many">{BALL}</replicate>')
    yield (
        "a cloth of 10^6 points",
        with_body('<flexcomp name="f" type="grid" count="1000 1000 1" spacing=".1 .1 .1" radius=".01"/>'),
    )
    yield (
        "a texture of 60,000 x 60,000",
        with_top('<asset><texture name="t" type="2d" builtin="flat" width="60000" height="60000"/></asset>'),
    )
    yield (
        "a texture of -1 x 5",
        with_top('<asset><texture name="t" type="2d" builtin="flat" width="-1" height="5"/></asset>'),
    )
    yield (
        "a height field of 40,000 x 40,000",
        with_top('<asset><hfield name="h" nrow="40000" ncol="40000" size="1 1 1 1"/></asset>'),
    )
    yield "user data of 2 * 10^9", with_top('<size nuser_body="2000000000"/>')
    yield "2 * 10^9 key frames", with_top('<size nkey="2000000000"/>')
    yield "an arena of 100 GB", with_top('<size memory="100G"/>')
    yield "a negative arena", with_top('<size memory="-5"/>')
    yield "a sensor of 10^9 numbers", SCENE.replace("</sensor>", '<user dim="1000000000"/></sensor>')
    yield (
        "an image of 10^6 x 10^6 off screen",
        with_top('<visual><global offwidth="1000000" offheight="1000000"/></visual>'),
    )
    yield "an escape sequence in a name", SCENE.replace('name="arm"', 'name="&#27;[31m"')
    yield "entities", "<!DOCTYPE x [<!ENTITY a 'b'><!ENTITY c '&a;&a;&a;'>]>" + SCENE
    yield "an entity of a file", '<!DOCTYPE x [<!ENTITY a SYSTEM "/etc/hostname">]>' + SCENE.replace('"arm"', '"&a;"')
    yield "a script", with_top('<extension><plugin plugin="nothing"/></extension>')
    yield "the file includes itself", with_top(f'<include file="{FILE}"/>')
    yield (
        "the file attaches itself",
        with_top(f'<asset><model name="m" file="{FILE}"/></asset>').replace(
            "</worldbody>", '<attach model="m" prefix="a"/></worldbody>'
        ),
    )
    yield "it includes a file that is missing", with_top('<include file="gone.xml"/>')
    yield "it includes /dev/zero", with_top('<include file="/dev/zero"/>')
    yield "it includes /etc/passwd", with_top('<include file="/etc/passwd"/>')
    yield "an object that is missing", with_top('<custom><text name="concent_objects" data="brick"/></custom>')
    yield "an object without a body", with_top('<custom><text name="concent_objects" data="world"/></custom>')


def mesh(name: str, content: bytes | str | None, file: str) -> Input:
    """Return a scene with the mesh of a file."""
    text = with_top(f'<asset><mesh name="m" file="{file}"/></asset>')
    text = text.replace("</worldbody>", '<body><freejoint/><geom type="mesh" mesh="m"/></body></worldbody>')
    beside = [] if content is None else [write(file, content)]
    return f"mesh: {name}", FILE, several(write(FILE, text), *beside)


def meshes() -> Iterator[Input]:
    """Yield scenes with broken meshes and pictures."""
    yield mesh("missing", None, "gone.stl")
    yield mesh("text in an STL", "solid x\nfacet\n", "a.stl")
    yield mesh("an empty STL", "", "a.stl")
    yield mesh("an STL of 2^32 triangles", b"\0" * 80 + b"\xff" * 4 + b"\0" * 50, "a.stl")
    yield mesh(
        "an STL with NaN",
        b"\0" * 80 + struct.pack("<I", 4) + struct.pack("<12fH", *[float("nan")] * 12, 0) * 4,
        "a.stl",
    )
    yield mesh("an OBJ without faces", "v 0 0 0\nv 1 0 0\n", "a.obj")
    yield mesh("an OBJ with a face of unknown points", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99\n", "a.obj")
    yield mesh("a flat OBJ", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "a.obj")
    yield mesh(
        "a PLY that declares 10^12 points",
        "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\nproperty float x\nend_header\n",
        "a.ply",
    )
    yield mesh("an OFF of text", "OFF\nmany few\n", "a.off")
    yield mesh("a GLB cut", b"glTF\x02\0\0\0\xff\xff\0\0", "a.glb")
    yield mesh("an unknown kind", "x", "a.3ds")
    yield mesh("no suffix", "x", "mesh")
    yield mesh("/dev/zero", None, "/dev/zero")
    yield mesh("/etc/passwd", None, "/etc/passwd")
    header = b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 6, 0, 0, 0)
    picture = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    texture = with_top('<asset><texture name="t" type="2d" file="t.png"/></asset>')
    yield "a PNG of 100,000 x 100,000", FILE, several(write(FILE, texture), write("t.png", picture))
    yield "a PNG cut", FILE, several(write(FILE, texture), write("t.png", picture[:20]))
    field = with_top('<asset><hfield name="h" file="h.bin" size="1 1 1 1"/></asset>')
    yield "a height field of -5 rows", FILE, several(write(FILE, field), write("h.bin", struct.pack("<ii", -5, 7)))
    yield "a height field cut", FILE, several(write(FILE, field), write("h.bin", struct.pack("<ii", 500, 700)))


def files() -> Iterator[Input]:
    """Yield paths that are no MJCF files."""
    yield "missing file", "gone.xml", lambda _: None
    yield "a folder", "folder.xml", lambda folder: (folder / "folder.xml").mkdir()
    yield "a pipe", "pipe.xml", lambda folder: os.mkfifo(folder / "pipe.xml")
    yield "/dev/zero", "zero.xml", lambda folder: (folder / "zero.xml").symlink_to("/dev/zero")
    yield "binary", FILE, write(FILE, bytes(range(256)))
    yield "UTF-16", FILE, write(FILE, SCENE.encode("utf-16"))
    yield "NUL bytes", FILE, write(FILE, SCENE.replace("arm", "a\0m"))
    yield (
        "two files that include each other",
        FILE,
        several(
            write(FILE, with_top('<include file="b.xml"/>')),
            write("b.xml", f'<mujocoinclude><include file="{FILE}"/></mujocoinclude>'),
        ),
    )


def cases() -> Iterator[Case]:
    """Yield broken scenes."""
    written = [(name, FILE, write(FILE, text)) for name, text in texts()]
    yield from crossed("scenes", Rotation(READERS), [*written, *meshes(), *files()])
