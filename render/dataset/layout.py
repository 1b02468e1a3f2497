"""Layout of episodes, and the staging folder of a data set: complete episodes stay there until they are packed.

A data set that is killed while it grows loses nothing that was saved: an episode is staged in one piece, packed files
count only once the table of episodes names them, and staged episodes go only when it does.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from concent_warp.errors import RenderError
from concent_warp.run_folder import EPISODES

STAGING = EPISODES
"""Folder of the episodes that are not packed."""
PARTIAL = ".partial"


@dataclass(frozen=True)
class EpisodeLayout:
    """Contents of every frame of a data set."""

    rate: int
    """Frame rate [Hz]."""
    cameras: tuple[str, ...]
    size: tuple[int, int]
    """Height and width of images [px]."""
    state: tuple[str, ...]
    """Names of the state's numbers."""
    action: tuple[str, ...]
    """Names of the action's numbers."""
    robot: str = "arm"
    """Kind of robot."""
    depths: tuple[str, ...] = ()
    """Cameras with depth."""
    more: tuple[tuple[str, tuple[str, ...]], ...] = ()
    """Names of other features, each with the names of its numbers, which may be NaN."""

    def __post_init__(self) -> None:
        height, width = self.size
        if self.rate < 1 or self.rate != int(self.rate):
            raise RenderError("the rate of frames is not right", expected="a whole number of frames/s", found=self.rate)
        if not (self.state and self.action):
            found = f"{len(self.state)} numbers of state and {len(self.action)} of action"
            raise RenderError("a data set needs a state and an action", found=found)
        if height % 2 or width % 2 or height < 16 or width < 16:
            raise RenderError("images of this size make no video", expected="even, at least 16 x 16", found=self.size)

    def check(self, images: Mapping[str, np.ndarray], state: np.ndarray, action: np.ndarray) -> None:
        """Raise unless a frame agrees with the layout.

        Raises:
            RenderError: An image, the state or the action has another shape or type, or is not finite.
        """
        if set(images) != set(self.cameras):
            raise RenderError("a frame has other cameras", expected=list(self.cameras), found=list(images))
        for name, image in images.items():
            if image.shape != (*self.size, 3) or image.dtype != np.uint8:
                expected, found = f"({self.size[0]}, {self.size[1]}, 3) uint8", f"{image.shape} {image.dtype}"
                raise RenderError("an image is not right", where=name, expected=expected, found=found)
        for name, value, names in (("state", state, self.state), ("action", action, self.action)):
            if np.shape(value) != (len(names),) or not np.isfinite(value).all():
                raise RenderError(
                    f"a frame's {name} is not right", expected=f"{len(names)} finite numbers", found=value
                )

    def described(self) -> dict[str, Any]:
        """Return the layout as plain data, without what a data set of images does not have."""
        return {name: value for name, value in asdict(self).items() if name not in ("depths", "more") or value}


class EpisodeWriter(Protocol):
    """An episode that grows frame by frame; images go to disk as they come."""

    def add(
        self,
        images: Mapping[str, np.ndarray],
        state: np.ndarray,
        action: np.ndarray,
        *,
        more: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Add a frame: images (H, W, 3) uint8, state and action, and the other features that the layout names."""
        ...

    def save(self, *, success: bool = True) -> None:
        """Make it part of the data set; `success` is whether the task was done, for formats that have rewards."""
        ...

    def drop(self) -> None:
        """Exclude the episode, now and when the data set is continued."""
        ...

    def discard(self) -> None:
        """Discard the episode and what is on the disk of it; it is rendered again when the data set is continued."""
        ...


class DatasetWriter(Protocol):
    """A data set that grows episode by episode, each with a number that its source gives it."""

    def has(self, key: int) -> bool:
        """Return whether the episode of a number has been saved or dropped."""
        ...

    def begin(self, key: int, task: str) -> EpisodeWriter:
        """Begin an episode."""
        ...

    def finish(self) -> int:
        """Pack what is staged, so that the data set can be read; return how many episodes it has."""
        ...


class Staging:
    """The folder of staged episodes of a data set."""

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        """Open it; what was being written when a process was killed is cleared away.

        Raises:
            RenderError: The data set was begun with other settings.
        """
        self.folder = folder / STAGING
        self.folder.mkdir(parents=True, exist_ok=True)
        for left in self.folder.glob(f"*{PARTIAL}"):
            shutil.rmtree(left)
        described = self.folder / "settings.json"
        given = json.loads(json.dumps(settings))
        if described.exists() and (before := json.loads(described.read_text())) != given:
            differing = sorted(name for name in before | given if before.get(name) != given.get(name))
            raise RenderError(
                "the data set was begun with other settings",
                where=folder,
                expected={name: before.get(name) for name in differing},
                found={name: given.get(name) for name in differing},
                fix="repeat them, or start anew with --overwrite",
            )
        replace_text(described, json.dumps(given))

    def numbers(self) -> list[int]:
        """Return the numbers of the staged episodes."""
        return sorted(int(path.name) for path in self.folder.iterdir() if path.name.isdigit())

    def dropped(self) -> set[int]:
        """Return the numbers of the episodes that were left out."""
        return {int(path.name.split("-")[1]) for path in self.folder.glob("dropped-*")}

    def path(self, key: int) -> Path:
        """Return the folder of a staged episode."""
        return self.folder / f"{key:06d}"

    def begin(self, key: int) -> Path:
        """Return an empty folder to write an episode to."""
        partial = self.folder / f"{key:06d}{PARTIAL}"
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        return partial

    def commit(self, key: int) -> None:
        """Take over the folder that `begin` returned."""
        partial = self.folder / f"{key:06d}{PARTIAL}"
        for path in partial.iterdir():
            _sync(path)
        partial.rename(self.path(key))

    def discard(self, key: int) -> None:
        """Take away the folder that `begin` returned."""
        shutil.rmtree(self.folder / f"{key:06d}{PARTIAL}", ignore_errors=True)

    def drop(self, key: int) -> None:
        """Note that an episode is to be left out."""
        shutil.rmtree(self.folder / f"{key:06d}{PARTIAL}", ignore_errors=True)
        (self.folder / f"dropped-{key:06d}").touch()

    def forget(self, keys: Sequence[int]) -> None:
        """Take away staged episodes, which have been packed."""
        for key in keys:
            shutil.rmtree(self.path(key), ignore_errors=True)


def _sync(path: Path) -> None:
    """Have the system put a file on the disk."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


@contextmanager
def published(path: Path) -> Iterator[Path]:
    """Yield the name under which to write a file, with its suffix, and give it its own name when it is on the disk.

    The folder is made. What was written is removed if writing fails.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{path.name}")
    try:
        yield partial
        _sync(partial)
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def replace_text(path: Path, text: str) -> None:
    """Write a text file in one piece or not at all."""
    with published(path) as partial:
        partial.write_text(text)
