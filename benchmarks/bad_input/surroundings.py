"""Standard output that cannot be written, and places where a command cannot or must not write."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.bad_input.case import Case, several, write

AREA = "surroundings"
WRITERS = {
    "geometry": "geometry scene.xml -o {}.toml --count 20",
    "fit": "fit recording.h5 -o {} --fit.generations 1",
    "replay": "replay recording.h5 --model model.toml -o {}.npz",
    "events": "events recording.h5 --model model.toml -o {}",
    "compare": "compare recording.h5 --html {}.html",
    "diagnose": "diagnose recording.h5 --jobs 1 -o {}",
    "suggest": "suggest recording.h5 --diagnosis found.json --method menu -o {}.h5",
    "locate": "locate recording.h5 --png {}.png",
    "add": "add joint_friction --model model.toml --target elbow -o {}.toml",
    "train": "train policy/demonstration.h5 --model policy/model.toml --events policy/events.json --device cpu -o {}",
    "export": "export --checkpoint policy -o {}.onnx",
    "evaluate": "evaluate --checkpoint policy --device cpu --episodes 1 --videos 1 -o {}",
    "render": "render --checkpoint policy --device cpu -o {}",
    "render-train": "render-train recording.h5 --device cpu -o {}",
    "demo": "demo -o {}",
    "record": "record -o {}.h5",
}
"""Command lines that write a file or a folder."""
KEEPING = ("events", "diagnose", "evaluate")
"""Commands that write files of their own names beside those that a folder has."""
OTHER = write("mine/notes.txt", "notes")
"""A folder with something that is no run."""
RUN = several(
    write("run/settings.toml", "seed = 0\n"),
    write("run/model.toml", "an earlier model"),
    write("run/notes.txt", "notes"),
)
"""The folder of an earlier run."""


def places() -> Iterator[Case]:
    """Yield outputs where nothing can be written."""
    for command, line in WRITERS.items():
        policy = "policy" in line
        yield Case(AREA, "output below a file", line.format("scene.xml/out"), policy=policy)
        yield Case(AREA, "output in /proc", line.format("/proc/nothing/out"), policy=policy)
        if command in KEEPING:
            continue
        given = line.format("there").split()[-1 if command not in ("geometry", "fit") else 3]
        there = write(given, "mine") if "." in given else write(f"{given}/notes.txt", "notes")
        yield Case(AREA, "output that exists already", line.format("there"), there, policy=policy)
    for name in ("fit", "train", "render", "render-train", "demo"):
        line, policy = WRITERS[name], "policy" in WRITERS[name]
        yield Case(
            AREA,
            "output folder with other things, --overwrite",
            line.format("mine") + " --overwrite",
            OTHER,
            policy=policy,
        )
        yield Case(AREA, "output folder that is a file", line.format("scene.xml"), policy=policy)


def failing() -> Iterator[Case]:
    """Yield commands that would replace an earlier run and fail: the run is to survive."""
    lines: dict[str, tuple[str, Callable[[Path], object]]] = {
        "a missing recording": ("fit gone.h5 -o run --overwrite", RUN),
        "a broken recording": ("fit recording.h5 -o run --overwrite", several(RUN, write("recording.h5", "x"))),
        "a broken model": (
            "fit recording.h5 --model model.toml -o run --overwrite", several(RUN, write("model.toml", "x"))
        ),
        "unknown demonstrations": ("fit recording.h5 --demonstrations demo_9 -o run --overwrite", RUN),
        "generations of -1": ("fit recording.h5 --fit.generations -1 -o run --overwrite", RUN),
        "an unknown stage": (
            "train policy/demonstration.h5 --model policy/model.toml --events policy/events.json --stage dance "
            "--device cpu -o run --overwrite", RUN,
        ),
        "no iterations": (
            "train policy/demonstration.h5 --model policy/model.toml --iterations 0 --device cpu -o run --overwrite",
            RUN,
        ),
        "a start from the run itself": (
            "train policy/demonstration.h5 --model policy/model.toml --events policy/events.json --begin-with policy "
            "--device cpu -o policy --overwrite", lambda _: None,
        ),
        "a missing policy": ("render --checkpoint gone -o run --overwrite", RUN),
        "a recording without images": ("render-train csv -o run --overwrite", RUN),
        "a seed of -1": ("demo --seeds -1 -o run --overwrite", RUN),
        "a demonstration of no cameras": ("render-train recording.h5 --cameras x -o run --overwrite", RUN),
        "a model that is written over its input": ("geometry gone.xml -o model.toml --overwrite", lambda _: None),
        "a missing comparison": ("compare gone.h5 --html run/notes.txt --overwrite", RUN),
        "a rollout of a broken recording": (
            "replay recording.h5 --model model.toml -o servo.json --overwrite", write("recording.h5", "x")
        ),
    }  # fmt: skip
    for name, (line, build) in lines.items():
        yield Case(AREA, f"--overwrite with {name}", line, build, policy="policy" in line)


def streams() -> Iterator[Case]:
    """Yield standard outputs that are full, closed or ASCII only."""
    for line in ("compare recording.h5", "locate recording.h5", "compare recording.h5 --json", "add --list", "--help"):
        yield Case(AREA, "standard output is full", line, stdout="full")
        yield Case(AREA, "standard output is closed", line, accepted=True, stdout="closed")
        yield Case(AREA, "standard output is ASCII", line, accepted=True, stdout="ascii")
    for stdout in ("full", "closed", "ascii"):
        yield Case(AREA, f"an error, while standard output is {stdout}", "compare gone.h5", stdout=stdout)


def cases() -> Iterator[Case]:
    """Yield cases of outputs."""
    yield from places()
    yield from failing()
    yield from streams()
