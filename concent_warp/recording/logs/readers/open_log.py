"""Opening of a log of any kind; the kind is determined from the path."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from concent_warp.errors import RecordingError
from concent_warp.recording.logs.readers.csv_table import CsvTable
from concent_warp.recording.logs.readers.image_folder import ImageFolder
from concent_warp.recording.logs.readers.kinds import KINDS, log_kind
from concent_warp.recording.logs.readers.lerobot import LeRobotLog
from concent_warp.recording.logs.readers.log import Log
from concent_warp.recording.logs.readers.ros import RosLog


def open_log(path: Path | str, parts: Collection[str] = ()) -> Log:
    """Open a LeRobot data set, an MCAP file, a ROS bag, a table or a folder of images; `parts` as in `log_sources`.

    Raises:
        RecordingError: There is none of them, or its description cannot be read.
    """
    path = Path(path)
    if not path.exists():
        raise RecordingError("no such log", where=path, expected=KINDS, fix="check the path")
    kind = log_kind(path, parts)
    if kind == "lerobot":
        return LeRobotLog(path)
    if kind == "ros":
        return RosLog(path)
    if kind == "images":
        return ImageFolder(path)
    if kind == "table":
        return CsvTable(path)
    if kind == "bop":
        raise RecordingError("a scene of a BOP data set is no log with a map", where=path, fix="import it without one")
    if path.suffix in (".h5", ".hdf5", ".pt"):
        raise RecordingError("this is no log to import", where=path, fix="every command reads it as it is")
    found = path.suffix or ("another folder" if path.is_dir() else "no suffix")
    fix = "write it as a table, or as a recording: docs/recording.md, Writing one" if path.is_file() else None
    raise RecordingError("unknown kind of log", where=path, expected=KINDS, found=found, fix=fix)
