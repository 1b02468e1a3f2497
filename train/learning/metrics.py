"""What each round of a training came to: lines of JSON in its run folder, and curves for TensorBoard where it is."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from concent_warp.files import write_text

CURVE = "curve.jsonl"
"""File of the rounds in a run folder."""
Point = dict[str, Any]
"""Rounds, environment steps and seconds so far, and what the round was logged to have come to."""


def read_curve(folder: Path) -> list[Point]:
    """Return the rounds of a run folder, in their order; none where none are written."""
    path = folder / CURVE
    lines = path.read_text().splitlines() if path.is_file() else []
    return [json.loads(line) for line in lines if line.endswith("}")]  # the last may have been cut short


@contextmanager
def curve(folder: Path, steps: int) -> Iterator[Callable[[Point], None]]:
    """Give what writes a round, after those of the first `steps` environment steps; later ones are forgotten."""
    kept = [json.dumps(point) + "\n" for point in read_curve(folder) if point["steps"] <= steps]
    write_text(folder / CURVE, "".join(kept))
    with (folder / CURVE).open("a") as file, _tensorboard(folder, steps) as board:

        def write(point: Point) -> None:
            file.write(json.dumps(point) + "\n")
            file.flush()
            board(point)

        yield write


@contextmanager
def _tensorboard(folder: Path, steps: int) -> Iterator[Callable[[Point], None]]:
    """Give what writes a round to TensorBoard, nothing where it is not installed."""
    try:
        from torch.utils.tensorboard.writer import SummaryWriter
    except ImportError:
        yield lambda _: None
        return
    with SummaryWriter(str(folder), purge_step=steps + 1, flush_secs=10) as writer:

        def write(point: Point) -> None:
            for name in point.keys() - {"iteration", "steps", "seconds"}:
                writer.add_scalar(name.replace(" ", "_"), point[name], point["steps"], point["seconds"])

        yield write
