"""LeRobotDataset v3.0: tables of many episodes a file, videos beside them.

The layout is that of https://huggingface.co/docs/lerobot/lerobot-dataset-v3, read with pyarrow and PyAV alone: the
lerobot package pins versions of torch and Python. ``meta/info.json`` has the features, ``meta/episodes/`` tells where
an episode lies in tables and videos. Column k of a feature is called ``<feature>/<name of k>``.
"""

from __future__ import annotations

import string
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.documents import is_number, read_json
from concent_warp.errors import RecordingError
from concent_warp.limits import limits
from concent_warp.recording.logs.readers.log import Episode, Images, Signal
from concent_warp.recording.logs.readers.video import DepthCodes, read_frames

VERSION = "v3."
BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Features that every data set has."""
SUCCESS = "next.success"
NUMBERS = ("float", "int", "bool")


class LeRobotLog:
    """A LeRobot data set."""

    kind = "LeRobot data set"

    def __init__(self, folder: Path) -> None:
        """Read the description.

        Raises:
            RecordingError: It is of another version, or something of it is missing.
        """
        self.source = Path(folder)
        path = self.source / "meta" / "info.json"
        info = read_json(path, RecordingError)
        if not isinstance(info, dict) or not isinstance(info.get("features"), dict):
            raise RecordingError("not the description of a LeRobot data set", where=path, expected="features by name")
        version = str(info.get("codebase_version", "none"))
        if not version.startswith(VERSION):
            fix = "convert it with lerobot: python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id NAME"
            raise RecordingError(
                "another version of LeRobot data sets", where=path, expected="v3.0", found=version, fix=fix
            )
        rate = info.get("fps")
        if not is_number(rate) or rate <= 0:
            raise RecordingError("fps is not a rate", where=path, expected="frames a second", found=repr(rate))
        self.rate = float(rate)
        self.info: dict[str, Any] = info

    @property
    def numbers(self) -> Sequence[int]:
        """Numbers of the episodes."""
        return sorted(self._rows)

    @cached_property
    def features(self) -> dict[str, dict[str, Any]]:
        """Descriptions of the features by name."""
        found = {}
        for name, feature in self.info["features"].items():
            if not isinstance(feature, dict) or not isinstance(feature.get("dtype"), str):
                raise RecordingError("a feature has no dtype", where=self.source / "meta" / "info.json", found=name)
            found[name] = feature
        return found

    def episode(self, number: int) -> Episode:
        """See `Log.episode`."""
        row = self._rows[number]
        path = self._path(self.info.get("data_path"), row, "data")
        table = _read_table(path, [("episode_index", "=", number)])
        length = table.num_rows
        if length != row.get("length", length) or length == 0:
            raise RecordingError(
                "an episode lacks rows", where=f"{path}, episode {number}", expected=row.get("length"), found=length,
                fix="check that the data set is complete",
            )  # fmt: skip
        if "frame_index" in table.column_names:
            table = table.sort_by("frame_index")
        if "timestamp" not in table.column_names:
            raise RecordingError("the table has no time stamps", where=path, expected="a column timestamp")
        time = table["timestamp"].to_numpy().astype(float)
        signals: dict[str, Signal] = {}
        images: dict[str, Images] = {}
        for name, feature in self.features.items():
            if feature["dtype"] in ("video", "image"):
                images[name] = self._images(name, feature, row, time, table)
            elif feature["dtype"].startswith(NUMBERS) and name not in BOOKKEEPING and name in table.column_names:
                signals |= self._signals(name, feature, table[name], time, path)
        success = signals.pop(SUCCESS, None)
        return Episode(
            number,
            signals,
            images,
            task=" ".join(str(task) for task in row.get("tasks") or []),
            success=None if success is None else bool(np.nansum(success.value) > 0),
        )

    def _signals(
        self, name: str, feature: Mapping[str, Any], column: Any, time: np.ndarray, path: Path
    ) -> dict[str, Signal]:
        """Return the columns of a feature by name."""
        try:
            value = np.array(column.to_pylist(), dtype=float).reshape(len(time), -1)
        except (ValueError, TypeError):
            where = f"{path}, feature {name!r}"
            raise RecordingError(
                "rows of a feature differ in their length", where=where, fix="mend the table"
            ) from None
        command = name.split(".")[0] == "action"
        if value.shape[1] == 1 and not _names(feature):
            return {name: Signal(name, time, value[:, 0], command=command)}
        names = _names(feature)
        if len(names) != value.shape[1]:
            names = [str(k) for k in range(value.shape[1])]
        columns = (f"{name}/{one}" for one in names)
        return {one: Signal(one, time, value[:, k], command=command) for k, one in enumerate(columns)}

    def _images(
        self, name: str, feature: Mapping[str, Any], row: Mapping[str, Any], time: np.ndarray, table: Any
    ) -> Images:
        """Return the frames of a feature."""
        where = f"{self.source / 'meta' / 'info.json'}, feature {name!r}"
        info = {**(feature.get("video_info") or {}), **(feature.get("info") or {})}
        depth = bool(info.get("is_depth_map") or info.get("video.is_depth_map"))
        named = dict(zip(_names(feature), feature.get("shape") or [], strict=False))
        height, width = named.get("height"), named.get("width")
        if not (isinstance(height, int) and isinstance(width, int) and min(height, width) > 0):
            raise RecordingError("a feature of images has no size", where=where, expected="height and width in shape")
        size = height, width
        if feature["dtype"] == "image":
            cells = table[name]
            return Images(name, time, size, depth, lambda rows: _decoded(cells, rows, where, depth=depth))
        path = self._path(self.info.get("video_path"), row, f"videos/{name}", video_key=name)
        begins = row.get(f"videos/{name}/from_timestamp")
        if not is_number(begins):
            raise RecordingError("the table of episodes does not say where a video begins", where=where)
        codes = DepthCodes.of(info, where) if depth else None
        # Frames of a video are at multiples of the period, whatever the stamps of the rows are.
        return Images(
            name, time, size, depth,
            lambda rows: read_frames(path, begins + rows / self.rate, rate=self.rate, depth=codes),
            unit="m",
        )  # fmt: skip

    @cached_property
    def _rows(self) -> dict[int, dict[str, Any]]:
        """Rows of the table of episodes by their numbers, without statistics."""
        folder = self.source / "meta" / "episodes"
        paths = sorted(folder.glob("chunk-*/file-*.parquet"))
        if not paths:
            raise RecordingError("the data set has no table of episodes", where=folder, fix="copy or download it too")
        rows: dict[int, dict[str, Any]] = {}
        for path in paths:
            table = _read_table(path)
            kept = [name for name in table.column_names if not name.startswith("stats/")]
            if "episode_index" not in kept:
                raise RecordingError("the table of episodes has no column episode_index", where=path)
            rows |= {int(row["episode_index"]): row for row in table.select(kept).to_pylist()}
        if len(rows) > limits().demonstrations:
            raise RecordingError("too many episodes", where=folder, expected=limits().demonstrations, found=len(rows))
        return rows

    def _path(self, pattern: Any, row: Mapping[str, Any], part: str, **more: str) -> Path:
        """Return the file of an episode in the data set's folder, from the pattern of its description."""
        where = self.source / "meta" / "info.json"
        fields = {"chunk_index": row.get(f"{part}/chunk_index"), "file_index": row.get(f"{part}/file_index"), **more}
        try:
            named = {field for _, field, _, _ in string.Formatter().parse(pattern) if field is not None}
            if not named <= set(fields):
                raise ValueError
            path = self.source / pattern.format(**fields)
        except (TypeError, ValueError):
            raise RecordingError(f"the paths of {part} are not right", where=where, found=repr(pattern)) from None
        if not path.resolve().is_relative_to(self.source.resolve()):
            raise RecordingError("a path leads out of the data set", where=where, found=path)
        return path


def _names(feature: Mapping[str, Any]) -> list[str]:
    """Return the names of a feature's columns; empty where it names none."""
    names = feature.get("names")
    if isinstance(names, dict):  # written by converters of older data sets: {"motors": [...]}
        names = next((one for one in names.values() if isinstance(one, list)), None)
    return [str(name) for name in names] if isinstance(names, list) else []


def _read_table(path: Path, filters: Any = None) -> Any:
    """Return a table, or its rows that pass filters."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not path.is_file():
        raise RecordingError("a table of the data set is missing", where=path, fix="copy or download it too")
    try:
        return pq.read_table(path, filters=filters)
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        found = " ".join(str(error).split())[:200]
        raise RecordingError("a table of the data set cannot be read", where=path, found=found) from None


def _decoded(cells: Any, rows: np.ndarray, where: str, *, depth: bool) -> Iterator[np.ndarray]:
    """Yield images that lie in a table as files."""
    import cv2

    for row in rows:
        cell = cells[int(row)].as_py()
        data = cell.get("bytes") if isinstance(cell, dict) else None
        image = None if not data else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None or image.ndim != (2 if depth else 3):
            raise RecordingError("an image in the table cannot be decoded", where=f"{where}, row {row}")
        yield image if depth else cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2RGB)
