"""Per-iteration metrics of a training: JSON lines in its run folder, and TensorBoard curves if it is installed."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from concent_warp.files import not_written, write_text

CURVE = "curve.jsonl"
"""File of per-iteration metrics in a run folder."""
Point = dict[str, Any]
"""Iterations, environment steps and seconds so far, with the metrics of the iteration, by name."""


def read_curve(folder: Path) -> list[Point]:
    """Return the metrics of a run folder in order of iterations; an empty list without a file."""
    path = folder / CURVE
    lines = path.read_text().splitlines() if path.is_file() else []
    return [
        json.loads(line) for line in lines if line.endswith("}")
    ]  # an interrupted write leaves the last line incomplete


@contextmanager
def curve(folder: Path, steps: int) -> Iterator[Callable[[Point], None]]:
    """Yield a function that appends the metrics of an iteration; earlier entries beyond `steps` environment steps are
    removed.
    """
    kept = [json.dumps(point) + "\n" for point in read_curve(folder) if point["steps"] <= steps]
    write_text(folder / CURVE, "".join(kept))
    with (folder / CURVE).open("ab", buffering=0) as file, _tensorboard(folder, steps) as board:

        def write(point: Point) -> None:
            line, end = json.dumps(point).encode() + b"\n", file.tell()
            try:
                while line:  # a full disk takes a part first
                    line = line[file.write(line) :]
            except OSError as error:
                file.truncate(end)
                raise not_written(folder / CURVE, error) from None
            board(point)

        yield write


@contextmanager
def _tensorboard(folder: Path, steps: int) -> Iterator[Callable[[Point], None]]:
    """Yield a function that writes metrics to TensorBoard, one without effect if it is not installed."""
    try:
        from torch.utils.tensorboard.writer import SummaryWriter
    except ImportError:
        yield lambda _: None
        return
    reported = threading.excepthook

    def report(thread: threading.ExceptHookArgs) -> None:
        """Leave what TensorBoard's thread cannot write to the main thread, which gets the error too."""
        if not issubclass(thread.exc_type, OSError):
            reported(thread)

    threading.excepthook = report
    try:
        with SummaryWriter(str(folder), purge_step=steps + 1, flush_secs=10) as writer:

            def write(point: Point) -> None:
                for name in point.keys() - {"iteration", "steps", "seconds"}:
                    writer.add_scalar(name.replace(" ", "_"), point[name], point["steps"], point["seconds"])

            yield write
    except OSError as error:
        if error.filename is not None:
            raise
        raise not_written(folder / "events.out.tfevents", error) from None
    finally:
        threading.excepthook = reported
