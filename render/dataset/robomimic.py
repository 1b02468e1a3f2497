"""robomimic's HDF5: one file, a group for each episode with observations, actions, rewards and ends.

Layout (https://robomimic.github.io/docs/datasets/overview.html): `data/demo_i/{obs/<name>, actions, rewards, dones}`
with the attribute `num_samples`; `data` has the attributes `total` and `env_args`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from concent_warp.files import DiskFile
from concent_warp.hdf5_output import new_hdf5
from concent_warp.render.dataset.layout import EpisodeLayout, Staging

NAME = "dataset.hdf5"
"""The file in the data set's folder."""
KEY = "source_index"
"""Attribute of an episode with the number that its source gave it."""
EPISODE = "episode.hdf5"
ENVIRONMENT_TYPE = 4
"""What robomimic takes an environment of another kind than its own for."""


class RobomimicWriter:
    """A file in robomimic's layout that grows episode by episode."""

    def __init__(self, folder: Path, layout: EpisodeLayout) -> None:
        """Open a data set, new or to be continued.

        Raises:
            RenderError: It was begun with other settings.
        """
        self.folder, self.layout = Path(folder), layout
        self._staging = Staging(self.folder, {"format": "robomimic", **layout.described()})
        self._done = self._packed() | set(self._staging.numbers()) | self._staging.dropped()

    def has(self, key: int) -> bool:
        """See `DatasetWriter.has`."""
        return key in self._done

    def begin(self, key: int, task: str) -> RobomimicEpisode:
        """See `DatasetWriter.begin`."""
        return RobomimicEpisode(self, key, task)

    def finish(self) -> int:
        """See `DatasetWriter.finish`; a file that is there is copied, so that it is whole at any time."""
        out, packed = self.folder / NAME, self._packed()
        staged = [key for key in self._staging.numbers() if key not in packed]
        with new_hdf5(out) as file:
            data: Any = file.create_group("data")
            if packed:
                with h5py.File(out, "r") as before:
                    for name in _entries(before, "data"):
                        before.copy(f"data/{name}", data, name=name)
            for k, key in enumerate(staged, start=len(packed)):
                with h5py.File(self._staging.path(key) / EPISODE, "r") as episode:
                    episode.copy("demo", data, name=f"demo_{k}")
                data[f"demo_{k}"].attrs[KEY] = key
            data.attrs["total"] = sum(int(data[name].attrs["num_samples"]) for name in data)
            data.attrs["env_args"] = json.dumps(
                {
                    "env_name": self.layout.robot,
                    "type": ENVIRONMENT_TYPE,
                    "env_kwargs": {"state": self.layout.state, "action": self.layout.action, "rate": self.layout.rate},
                }
            )
        self._staging.forget(self._staging.numbers())
        return len(packed) + len(staged)

    def _packed(self) -> set[int]:
        """Return the numbers of the episodes in the file."""
        path = self.folder / NAME
        if not path.exists():
            return set()
        with h5py.File(path, "r") as file:
            return {int(group.attrs[KEY]) for group in _entries(file, "data").values()}


def _entries(file: h5py.File, name: str) -> Any:
    """Return a group of a file; h5py cannot tell that it is one."""
    return file[name]


class RobomimicEpisode:
    """See `EpisodeWriter`."""

    def __init__(self, writer: RobomimicWriter, key: int, task: str) -> None:
        """Open the episode's file."""
        self._writer, self._key = writer, key
        height, width = writer.layout.size
        self._disk = DiskFile(writer._staging.begin(key) / EPISODE)
        self._file = h5py.File(self._disk, "w")
        self._group = self._file.create_group("demo")
        self._group.attrs["task"] = task
        frame = (1, height, width, 3)
        self._images = {
            camera: self._group.create_dataset(
                f"obs/{camera}_image", (0, *frame[1:]), np.uint8, maxshape=(None, *frame[1:]), chunks=frame,
                compression="gzip", compression_opts=1,
            )
            for camera in writer.layout.cameras
        }  # fmt: skip
        self._state: list[np.ndarray] = []
        self._action: list[np.ndarray] = []

    def add(
        self,
        images: Mapping[str, np.ndarray],
        state: np.ndarray,
        action: np.ndarray,
        *,
        more: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """See `EpisodeWriter.add`; there are no other features."""
        del more
        self._writer.layout.check(images, state, action)
        for camera, image in images.items():
            stored = self._images[camera]
            stored.resize(len(self._state) + 1, axis=0)
            stored[-1] = image
        self._disk.check()
        self._state.append(np.asarray(state, dtype=np.float64))
        self._action.append(np.asarray(action, dtype=np.float64))

    def save(self, *, success: bool = True) -> None:
        """See `EpisodeWriter.save`; the last frame ends it, and is rewarded if the task was done."""
        if not self._state:
            self.drop()
            return
        last = np.zeros(len(self._state))
        last[-1] = 1
        self._group.create_dataset("obs/state", data=np.stack(self._state))
        self._group.create_dataset("actions", data=np.stack(self._action))
        self._group.create_dataset("rewards", data=last * success)
        self._group.create_dataset("dones", data=last.astype(np.int64))
        self._group.attrs["num_samples"] = len(self._state)
        self._close()
        self._disk.check()
        self._writer._staging.commit(self._key)
        self._writer._done.add(self._key)

    def drop(self) -> None:
        """See `EpisodeWriter.drop`."""
        self._close()
        self._writer._staging.drop(self._key)
        self._writer._done.add(self._key)

    def discard(self) -> None:
        """See `EpisodeWriter.discard`."""
        self._close()
        self._writer._staging.discard(self._key)

    def _close(self) -> None:
        """Close the file; closing it twice is fine."""
        self._file.close()
        self._disk.close()
