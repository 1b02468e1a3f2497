"""LeRobotDataset v3.0: many episodes a file, videos beside tables, as the lerobot package reads it.

Files (https://huggingface.co/docs/lerobot/lerobot-dataset-v3): `data/` has the numbers of all frames, `videos/` the
images of each camera, `meta/episodes/` where each episode lies in both, with its statistics, `meta/tasks.parquet` the
texts, `meta/stats.json` the statistics of all, `meta/info.json` the features. The table of episodes decides what a data
set holds; everything else of it can be written again from the tables.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from concent_warp.recording.logs.readers.video import DepthCodes
from concent_warp.render.dataset.layout import EpisodeLayout, Staging, published, replace_text
from concent_warp.render.dataset.statistics import ImageHistogram, Statistics, merged_statistics, statistics_of_values
from concent_warp.render.dataset.video import DEPTH_PIXELS, PIXELS, Codec, VideoWriter, join_videos

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = "v3.0"
FILES_PER_CHUNK = 1000
"""Files of a folder."""
DATA_MB, VIDEO_MB = 100, 200
"""Sizes at which files are full [MB]."""
STATISTICS_PIXELS = 128
"""Rows and columns of an image that its statistics are taken from, about."""
MEGABYTE = 1_000_000
"""Of a megabyte."""
INDICES = ("frame_index", "episode_index", "index", "task_index")
KEY = "source_index"
"""Column of the table of episodes with the number that the source gave an episode."""


class LeRobotWriter:
    """A LeRobotDataset that grows episode by episode; memory is bounded by the number of unpacked episodes' tables."""

    def __init__(
        self, folder: Path, layout: EpisodeLayout, *, codec: Codec = "h264", video_mb: float = VIDEO_MB
    ) -> None:
        """Open a data set, new or to be continued.

        Args:
            folder: Its folder.
            layout: Contents of a frame.
            codec: Of the videos.
            video_mb: Size at which staged videos are packed to a file [MB].

        Raises:
            RenderError: It was begun with other settings.
        """
        self.folder, self.layout = Path(folder), layout
        self.codec: Codec = codec
        self._full = video_mb * MEGABYTE
        self._staging = Staging(self.folder, {"format": VERSION, "codec": codec, **layout.described()})
        self._episodes = self._packed()
        done = {int(row[KEY]) for row in self._episodes}
        self._staging.forget([key for key in self._staging.numbers() if key in done])
        self._done = done | set(self._staging.numbers()) | self._staging.dropped()

    def has(self, key: int) -> bool:
        """See `DatasetWriter.has`."""
        return key in self._done

    def begin(self, key: int, task: str) -> LeRobotEpisode:
        """See `DatasetWriter.begin`."""
        return LeRobotEpisode(self, key, task)

    def finish(self) -> int:
        """See `DatasetWriter.finish`."""
        if self._staging.numbers():
            self.pack()
        self._write_meta()
        return len(self._episodes)

    def staged(self, key: int, *, dropped: bool = False) -> None:
        """Take note of an episode that is whole; pack when a file is full."""
        self._done.add(key)
        if dropped:
            return
        videos = [path.stat().st_size for path in self._staging.folder.glob("[0-9]*/*.mp4")]
        if sum(videos) / max(len(self.layout.cameras), 1) >= self._full:
            self.pack()
            self._write_meta()

    def pack(self) -> None:
        """Turn the staged episodes into files of the data set."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        keys = self._staging.numbers()
        notes = [json.loads((self._staging.path(key) / "episode.json").read_text()) for key in keys]
        numbers = (
            int(row["data/file_index"]) + FILES_PER_CHUNK * int(row["data/chunk_index"]) for row in self._episodes
        )
        number = 1 + max(numbers, default=-1)
        where = {"chunk_index": number // FILES_PER_CHUNK, "file_index": number % FILES_PER_CHUNK}
        lengths = [note["length"] for note in notes]
        names = (*self.layout.cameras, *map(_depth_name, self.layout.depths))
        for camera in names:
            out = self.folder / _video_path(camera, where)
            videos = [self._staging.path(k) / f"{camera}.mp4" for k in keys]
            with published(out) as partial:
                join_videos(videos, lengths, self.layout.rate, partial)
        tasks, index = self.tasks(), int(self._episodes[-1]["dataset_to_index"]) if self._episodes else 0
        rows, tables, seconds = [], [], 0.0
        for key, note in zip(keys, notes, strict=True):
            if note["task"] not in tasks:
                tasks.append(note["task"])
            episode, length = len(self._episodes) + len(rows), note["length"]
            tables.append(self._numbered(key, episode, index, tasks.index(note["task"])))
            row = {"episode_index": episode, KEY: key, "tasks": [note["task"]], "length": length}
            row |= {f"data/{name}": value for name, value in where.items()}
            row |= {"dataset_from_index": index, "dataset_to_index": index + length}
            until = seconds + length / self.layout.rate
            for camera in names:
                prefix = f"videos/{_image_key(camera)}"
                row |= {f"{prefix}/{name}": value for name, value in where.items()}
                row |= {f"{prefix}/from_timestamp": seconds, f"{prefix}/to_timestamp": until}
            row |= {f"stats/{feature}/{name}": value for feature, named in note["stats"].items()
                    for name, value in named.items()}  # fmt: skip
            row |= {f"meta/episodes/{name}": value for name, value in where.items()}
            rows.append(row)
            index, seconds = index + length, until
        out = self.folder / _file_path("data", where)
        with published(out) as partial:
            pq.write_table(pa.concat_tables(tables), partial)
        self._write_tasks(tasks)
        # From here on the episodes belong to the data set.
        out = self.folder / _file_path("meta/episodes", where)
        with published(out) as partial:
            pq.write_table(pa.Table.from_pylist(rows), partial)
        self._episodes += rows
        self._staging.forget(keys)

    def tasks(self) -> list[str]:
        """Return the texts of the tasks by their numbers."""
        import pyarrow.parquet as pq

        path = self.folder / "meta" / "tasks.parquet"
        if not path.exists():
            return []
        table = pq.read_table(path)
        order = np.argsort(table["task_index"].to_numpy())
        return [table["task"][int(i)].as_py() for i in order]

    def features(self) -> dict[str, Any]:
        """Return the features as `info.json` has them."""
        height, width = self.layout.size
        found: dict[str, Any] = {}
        for camera in self.layout.cameras:
            found[_image_key(camera)] = {
                "dtype": "video",
                "shape": [height, width, 3],
                "names": ["height", "width", "channels"],
                "info": {
                    "video.height": height, "video.width": width, "video.codec": self.codec, "video.pix_fmt": PIXELS,
                    "video.is_depth_map": False, "video.fps": self.layout.rate, "video.channels": 3, "has_audio": False,
                },
            }  # fmt: skip
        for camera in self.layout.depths:
            codes = DepthCodes()
            found[_image_key(_depth_name(camera))] = {
                "dtype": "video",
                "shape": [height, width, 1],
                "names": ["height", "width", "channels"],
                "info": {
                    "video.height": height, "video.width": width, "video.codec": "hevc",
                    "video.pix_fmt": DEPTH_PIXELS, "video.fps": self.layout.rate, "video.channels": 1,
                    "has_audio": False, "is_depth_map": True, "video.depth_min": codes.smallest,
                    "video.depth_max": codes.largest, "video.shift": codes.shift, "video.use_log": codes.logarithmic,
                },
            }  # fmt: skip
        numbers = (("observation.state", self.layout.state), ("action", self.layout.action), *self.layout.more)
        for name, names in numbers:
            found[name] = {"dtype": "float32", "shape": [len(names)], "names": list(names)}
        found["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
        return found | {name: {"dtype": "int64", "shape": [1], "names": None} for name in INDICES}

    def _packed(self) -> list[dict[str, Any]]:
        """Return the rows of the table of episodes that are on the disk."""
        import pyarrow.parquet as pq

        files = sorted((self.folder / "meta" / "episodes").glob("chunk-*/file-*.parquet"))
        return [row for path in files for row in pq.read_table(path).to_pylist()]

    def _numbered(self, key: int, episode: int, first: int, task: int) -> pa.Table:
        """Return the table of a staged episode with its place in the data set."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        table = pq.read_table(self._staging.path(key) / "data.parquet")
        count = table.num_rows
        columns = {
            "frame_index": np.arange(count),
            "episode_index": np.full(count, episode),
            "index": np.arange(first, first + count),
            "task_index": np.full(count, task),
        }
        for name, values in columns.items():
            table = table.append_column(name, pa.array(values, type=pa.int64()))
        return table

    def _write_tasks(self, tasks: Sequence[str]) -> None:
        """Write the texts, the column of texts marked as the index that pandas is to make of it."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        table = pa.table({"task_index": pa.array(range(len(tasks)), type=pa.int64()), "task": list(tasks)})
        columns = [
            {"name": name, "field_name": name, "pandas_type": pandas, "numpy_type": numpy, "metadata": None}
            for name, pandas, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
        ]
        pandas = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.2.0"}
        out = self.folder / "meta" / "tasks.parquet"
        with published(out) as partial:
            pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), partial)

    def _write_meta(self) -> None:
        """Write what follows from the table of episodes: statistics of all, and the description."""
        rows = self._episodes
        names = sorted({name.split("/")[1] for row in rows for name in row if name.startswith("stats/")})
        stats = {}
        for feature in names:
            prefix = f"stats/{feature}/"
            parts = [{n[len(prefix) :]: np.array(v) for n, v in row.items() if n.startswith(prefix)} for row in rows]
            stats[feature] = {name: value.tolist() for name, value in merged_statistics(parts).items()}
        replace_text(self.folder / "meta" / "stats.json", json.dumps(stats, indent=1))
        info = {
            "codebase_version": VERSION,
            "robot_type": self.layout.robot,
            "total_episodes": len(rows),
            "total_frames": int(rows[-1]["dataset_to_index"]) if rows else 0,
            "total_tasks": len(self.tasks()),
            "chunks_size": FILES_PER_CHUNK,
            "data_files_size_in_mb": DATA_MB,
            "video_files_size_in_mb": VIDEO_MB,
            "fps": self.layout.rate,
            "splits": {"train": f"0:{len(rows)}"},
            "data_path": _file_path("data"),
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
            "features": self.features(),
        }
        replace_text(self.folder / "meta" / "info.json", json.dumps(info, indent=1))


class LeRobotEpisode:
    """See `EpisodeWriter`."""

    def __init__(self, writer: LeRobotWriter, key: int, task: str) -> None:
        """Open the videos."""
        self._writer, self._key, self._task = writer, key, task
        layout, staging = writer.layout, writer._staging
        self._folder = staging.begin(key)
        self._videos = {
            camera: VideoWriter(self._folder / f"{camera}.mp4", layout.rate, layout.size, writer.codec)
            for camera in layout.cameras
        }
        self._depths = {
            camera: VideoWriter(self._folder / f"{_depth_name(camera)}.mp4", layout.rate, layout.size, "depth")
            for camera in layout.depths
        }
        self._metres: dict[str, list[np.ndarray]] = {camera: [] for camera in layout.depths}
        self._every = every = max(1, min(layout.size) // STATISTICS_PIXELS)
        self._seen = {camera: ImageHistogram(every) for camera in layout.cameras}
        self._state: list[np.ndarray] = []
        self._action: list[np.ndarray] = []
        self._more: dict[str, list[np.ndarray]] = {name: [] for name, _ in layout.more}

    def add(
        self,
        images: Mapping[str, np.ndarray],
        state: np.ndarray,
        action: np.ndarray,
        depths: Mapping[str, np.ndarray] | None = None,
        more: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """See `EpisodeWriter.add`; `depths` [m], shape (H, W), and `more` are those that the layout names."""
        self._writer.layout.check(images, state, action)
        for camera, video in self._depths.items():
            depth = np.asarray((depths or {})[camera])
            video.add(DepthCodes().codes(depth))
            self._metres[camera].append(depth[:: 4 * self._every, :: 4 * self._every].ravel())
        for name, values in self._more.items():
            values.append(np.asarray((more or {})[name], dtype=np.float32))
        for camera, image in images.items():
            self._videos[camera].add(image)
            self._seen[camera].add(image)
        self._state.append(np.asarray(state, dtype=np.float32))
        self._action.append(np.asarray(action, dtype=np.float32))

    def save(self, *, success: bool = True) -> None:
        """See `EpisodeWriter.save`; there is no place for success."""
        del success
        if not self._state:
            self.drop()
            return
        import pyarrow as pa
        import pyarrow.parquet as pq

        for video in (*self._videos.values(), *self._depths.values()):
            video.close()
        state, action = np.stack(self._state), np.stack(self._action)
        time = np.arange(len(state), dtype=np.float32) / np.float32(self._writer.layout.rate)
        more = {name: np.stack(values) for name, values in self._more.items()}
        columns = {"observation.state": _fixed(state), "action": _fixed(action), "timestamp": pa.array(time)}
        columns |= {name: _fixed(values) for name, values in more.items()}
        pq.write_table(pa.table(columns), self._folder / "data.parquet")
        stats: dict[str, Statistics] = {_image_key(c): seen.statistics() for c, seen in self._seen.items()}
        stats |= {
            "observation.state": statistics_of_values(state),
            "action": statistics_of_values(action),
            "timestamp": statistics_of_values(time[:, None]),
        }
        stats |= {name: statistics_of_values(_known_rows(values)) for name, values in more.items()}
        for camera, values in self._metres.items():
            named = statistics_of_values(np.concatenate(values)[:, None])
            count = {"count": np.array([len(state)])}
            key = _image_key(_depth_name(camera))
            stats[key] = {name: value.reshape(1, 1, 1) for name, value in named.items() if name != "count"} | count
        plain = {feature: {name: value.tolist() for name, value in named.items()} for feature, named in stats.items()}
        note = {"task": self._task, "length": len(state), "stats": plain}
        (self._folder / "episode.json").write_text(json.dumps(note))
        self._writer._staging.commit(self._key)
        self._writer.staged(self._key)

    def drop(self) -> None:
        """See `EpisodeWriter.drop`."""
        self._abandon()
        self._writer._staging.drop(self._key)
        self._writer.staged(self._key, dropped=True)

    def discard(self) -> None:
        """See `EpisodeWriter.discard`."""
        self._abandon()
        self._writer._staging.discard(self._key)

    def _abandon(self) -> None:
        """Close the videos, which are to be removed."""
        for video in (*self._videos.values(), *self._depths.values()):
            video.abandon()


def _fixed(values: np.ndarray) -> pa.Array:
    """Return a column of lists of one length, shape (T, n) float32."""
    import pyarrow as pa

    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def _known_rows(values: np.ndarray) -> np.ndarray:
    """Return the rows of values (T, n) without NaN, a row of zeros where there is none."""
    kept = values[np.isfinite(values).all(axis=1)]
    return kept if len(kept) else np.zeros((1, values.shape[1]))


def _depth_name(camera: str) -> str:
    """Return the name of a camera's depths."""
    return f"{camera}_depth"


def _image_key(camera: str) -> str:
    """Return the name of a camera's feature."""
    return f"observation.images.{camera}"


def _file_path(part: str, where: Mapping[str, int] | None = None) -> str:
    """Return the path of a table, or its pattern."""
    pattern = part + "/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    return pattern if where is None else pattern.format(**where)


def _video_path(camera: str, where: Mapping[str, int]) -> str:
    """Return the path of a video."""
    return _file_path(f"videos/{_image_key(camera)}", where).replace(".parquet", ".mp4")
