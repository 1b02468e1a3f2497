"""Rendering of the episodes of many worlds to a data set, frame by frame; each is kept or dropped at its end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from concent_warp.render.composite import Layers
from concent_warp.render.dataset.layout import DatasetWriter, EpisodeWriter
from concent_warp.render.dataset.video import VideoWriter
from concent_warp.render.figure import FrameSelection
from concent_warp.render.networks.pairs import to_bytes

FILMS = "films"
"""Folder of the MP4 videos, in that of the data set."""


class FilmCamera(Protocol):
    """What renders W worlds, frame by frame."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the C cameras."""
        ...

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of an image [px]."""
        ...

    def begin(self) -> None:
        """Begin episodes in all worlds."""
        ...

    def shoot(self, qpos: torch.Tensor | np.ndarray, mocap: tuple[torch.Tensor, torch.Tensor] | None = None) -> Layers:
        """Return the images of all worlds, see `HybridCamera.shoot`."""
        ...


class DatasetFilming:
    """Renders the episodes of W worlds to a data set."""

    def __init__(
        self,
        camera: FilmCamera,
        writer: DatasetWriter,
        task: str,
        *,
        films: Path | None = None,
        first_films: int = 0,
        rate: int = 20,
    ) -> None:
        """Prepare cameras and writers.

        Args:
            camera: Renders the worlds.
            writer: The data set.
            task: What is being done, in words.
            films: Folder for videos of the cameras side by side, besides the data set.
            first_films: How many episodes to make such videos of: those with the lowest numbers.
            rate: Frames a second.
        """
        self.camera, self.writer, self.task = camera, writer, task
        self.album = FrameSelection()
        """Frames of the first episode that is kept or dropped."""
        self._films, self._first, self._rate = films, first_films, rate
        self._open: dict[int, tuple[int, EpisodeWriter, VideoWriter | None]] = {}
        self._images = np.zeros(0, dtype=np.uint8)
        self._watched: int | None = None
        self.kept = self.dropped = 0

    def begin(self, keys: Sequence[int | None]) -> None:
        """Begin an episode in each of the W worlds, by its number in the data set; None for an idle world."""
        self.camera.begin()
        for world, key in enumerate(keys):
            if key is None:
                continue
            film = None
            if self._films is not None and key < self._first:
                self._films.mkdir(parents=True, exist_ok=True)
                height, width = self.camera.size
                size = (height, width * len(self.camera.cameras))
                film = VideoWriter(self._unfinished(key), self._rate, size)
            self._open[world] = (key, self.writer.begin(key, self.task), film)
            if self._watched is None:
                self._watched = world

    @property
    def images(self) -> np.ndarray:
        """Latest images of the W worlds, shape (W, C, H, W', 3) uint8."""
        return self._images

    @property
    def running(self) -> list[int]:
        """Worlds whose episode has not ended."""
        return list(self._open)

    def shoot(self, qpos: torch.Tensor | np.ndarray, mocap: tuple[torch.Tensor, torch.Tensor] | None = None) -> None:
        """Render all worlds as they are, qpos (W, nq) and mocap as for `HybridCamera.shoot`."""
        layers = self.camera.shoot(qpos, mocap)
        self._images = to_bytes(layers.image).cpu().numpy()
        if self._watched is not None and self._watched in self._open:
            self.album.add(layers, self._watched)

    def add(
        self,
        world: int,
        state: np.ndarray,
        action: np.ndarray,
        *,
        recorded: bool = True,
        more: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Add the frame of a world, with state, action and the other features that the layout names.

        Unless `recorded`, it goes to the video of the world alone.
        """
        _, episode, film = self._open[world]
        images = dict(zip(self.camera.cameras, self._images[world], strict=True))
        if recorded:
            episode.add(images, state, action, more=more)
        if film is not None:
            film.add(np.concatenate(list(images.values()), axis=1))

    def end(self, world: int, *, keep: bool, success: bool = True) -> None:
        """End the episode of a world, and keep it or not; `success` is whether the task succeeded."""
        key, episode, film = self._open.pop(world)
        if keep:
            try:
                self._end_film(key, film)
                episode.save(success=success)
            except OSError:  # as on a full disk
                episode.discard()
                raise
            self.kept += 1
        else:
            self._end_film(key, film)
            episode.drop()
            self.dropped += 1

    def _end_film(self, key: int, film: VideoWriter | None) -> None:
        """Close the video of an episode, if there is one, and give it its name."""
        if film is None or self._films is None:
            return
        try:
            film.close()
            self._unfinished(key).replace(self._films / f"episode_{key:06d}.mp4")
        except OSError:
            self._unfinished(key).unlink(missing_ok=True)
            raise

    def leave(self) -> None:
        """Discard the episodes that have not ended."""
        for key, episode, film in self._open.values():
            episode.discard()
            if film is not None:
                film.abandon()
                self._unfinished(key).unlink(missing_ok=True)
        self._open.clear()

    def _unfinished(self, key: int) -> Path:
        """Return the temporary file of a video."""
        assert self._films is not None
        return self._films / f".partial-{key:06d}.mp4"
