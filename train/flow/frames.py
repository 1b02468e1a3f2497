"""Images of a data set, decoded once, resized, and kept in a file for each camera.

The files grow episode by episode, and a note tells how many are whole, so that a decoding that was killed goes on where
it was. They are read as memory-mapped arrays: a data set may be larger than the memory.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from concent_warp.documents import read_json
from concent_warp.errors import ConcentError
from concent_warp.files import write_json
from concent_warp.run_folder import make_folder
from concent_warp.train.flow.network import prepared
from concent_warp.train.flow.sources import EpisodeSources

FRAMES = "frames"
"""Folder of the files within a run folder."""
NOTE = "checkpoint.frames.json"
"""File of the note in the run folder; by its name it is one from which a run is resumed."""
NOTE_PERIOD = 5.0
"""Time between notes of how many episodes are decoded [s]."""
BLOCK = 256
"""Frames that are resized at once."""
MAX_THREADS = 16
"""Threads that decode, at most."""


@dataclass(frozen=True)
class FrameFiles:
    """Images of K cameras in files."""

    files: tuple[Path, ...]
    """File of each camera."""
    count: int
    """Number T of frames."""
    edge: int
    """Height and width of the images [px]."""

    @property
    def bytes(self) -> int:
        """Size of all images."""
        return len(self.files) * self.count * self.edge * self.edge * 3

    def arrays(self) -> list[np.ndarray]:
        """Return the images of each camera, shape (T, S, S, 3) uint8, read from the disk when they are looked at."""
        shape = (self.count, self.edge, self.edge, 3)
        return [np.memmap(file, np.uint8, "r", shape=shape) for file in self.files]


def decode_episodes(
    log: EpisodeSources,
    cameras: Sequence[str],
    edge: int,
    lengths: Sequence[int],
    folder: Path,
    *,
    progress: Callable[[float], None] | None = None,
) -> FrameFiles:
    """Decode the images of all episodes, or go on with it.

    Args:
        log: The data sets.
        cameras: Features of images.
        edge: Height and width to which images are resized [px].
        lengths: Frames of each episode.
        folder: Run folder.
        progress: Called with the share of the frames that is decoded, 0..1.

    Raises:
        RecordingError: Images are missing or cannot be decoded.
        OSError: The files cannot be written, as on a full disk.
    """
    make_folder(folder / FRAMES)
    total, size = sum(lengths), edge * edge * 3
    files = tuple(folder / FRAMES / f"camera_{k}.uint8" for k in range(len(cameras)))
    settings = {"data": _fingerprint(log, lengths), "cameras": list(cameras), "edge": edge}
    done = _episodes_done(folder / NOTE, settings, files, size, lengths)
    threads = max(1, min(os.cpu_count() or 1, MAX_THREADS))
    written, noted = sum(lengths[:done]), time.monotonic()
    opened: list[BinaryIO] = []
    try:
        for file in files:
            opened.append(file.open("r+b" if file.exists() else "w+b"))
            opened[-1].truncate(written * size)
            opened[-1].seek(written * size)

        def note() -> None:
            for file in opened:
                file.flush()
                os.fsync(file.fileno())
            write_json(folder / NOTE, {**settings, "episodes": done})

        numbers = log.numbers
        groups = [*range(done, len(numbers), 2 * threads), len(numbers)]
        with ThreadPoolExecutor(threads) as pool:
            for first, last in pairwise(groups):
                found = pool.map(lambda n: _episode_images(log, n, cameras, edge), numbers[first:last])
                for images in found:
                    for file, frames in zip(opened, images, strict=True):
                        file.write(frames.tobytes())
                    written, done = written + lengths[done], done + 1
                    if progress is not None:
                        progress(written / total)
                if time.monotonic() - noted > NOTE_PERIOD:
                    note()
                    noted = time.monotonic()
        note()
    finally:
        for file in opened:
            file.close()
    return FrameFiles(files, total, edge)


def _episode_images(log: EpisodeSources, number: int, cameras: Sequence[str], edge: int) -> list[np.ndarray]:
    """Return the images of an episode by camera, each (T, S, S, 3) uint8."""
    episode, found = log.episode(number), []
    for camera in cameras:
        stream = episode.images[camera]
        out = np.empty((len(stream.time), edge, edge, 3), dtype=np.uint8)
        frames = stream.frames(np.arange(len(stream.time)))
        for first in range(0, len(out), BLOCK):
            block = np.stack(list(islice(frames, min(BLOCK, len(out) - first))))
            out[first : first + len(block)] = prepared(torch.from_numpy(block), edge).numpy()
        found.append(out)
    return found


def _fingerprint(log: EpisodeSources, lengths: Sequence[int]) -> str:
    """Return what tells data sets from others: their places, their descriptions and the lengths of their episodes."""
    found = hashlib.sha256(f"{list(lengths)}".encode())
    for one in log.logs:
        found.update(f"{one.source.resolve()}".encode() + (one.source / "meta" / "info.json").read_bytes())
    return found.hexdigest()


def _episodes_done(
    note: Path, settings: dict[str, object], files: Sequence[Path], size: int, lengths: Sequence[int]
) -> int:
    """Return how many episodes an earlier decoding with these settings left whole."""
    if not note.is_file():
        return 0
    try:
        found = read_json(note)
    except ConcentError:
        return 0
    if not isinstance(found, dict) or {name: found.get(name) for name in settings} != settings:
        return 0
    done = found.get("episodes")
    if not isinstance(done, int) or not 0 <= done <= len(lengths):
        return 0
    needed = sum(lengths[:done]) * size
    return done if all(file.is_file() and file.stat().st_size >= needed for file in files) else 0


def remove_frames(folder: Path) -> None:
    """Remove the images from a run folder, which a finished training does not need."""
    shutil.rmtree(folder / FRAMES, ignore_errors=True)
    (folder / NOTE).unlink(missing_ok=True)
