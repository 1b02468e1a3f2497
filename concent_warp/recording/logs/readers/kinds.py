"""Which kind of log a path is, from names, and from the headers of tables."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Literal

from concent_warp.errors import RecordingError
from concent_warp.recording.logs.readers.csv_table import TABLES, is_one_episode

LogKind = Literal["lerobot", "ros", "images", "bop", "table"]
KINDS = (
    "a LeRobot v3 data set (folder with meta/info.json), an MCAP file (.mcap), a ROS bag (.bag, .db3, or folder with "
    "metadata.yaml), a table (.csv), a folder with intrinsics.json and folders of colour and depth images, a scene of "
    "a BOP data set (folder with scene_camera.json), or a folder of logs"
)
BAGS = (".mcap", ".bag", ".db3")
COLOUR_FOLDERS = ("color", "colour", "rgb", "image", "images", "left")
DEPTH_FOLDERS = ("depth", "aligned_depth", "aligned_depth_to_color", "depth_aligned")
INTRINSICS = ("intrinsics.json", "camera_intrinsic.json", "intrinsic.json", "camera_intrinsics.json")
BOP_CAMERAS = "scene_camera.json"


def log_kind(path: Path, parts: Collection[str] = ()) -> LogKind | None:
    """Return the kind of log that a file or folder is, None for none that is known; `parts` as in `is_one_episode`."""
    if path.is_dir():
        if (path / "meta" / "info.json").exists():
            return "lerobot"
        if (path / "metadata.yaml").exists():
            return "ros"
        if (path / BOP_CAMERAS).exists() or any(path.glob(f"*/*/{BOP_CAMERAS}")):
            return "bop"
        folders = {one.name.lower() for one in path.iterdir() if one.is_dir()}
        if folders & {*COLOUR_FOLDERS, *DEPTH_FOLDERS} or any((path / name).exists() for name in INTRINSICS):
            return "images"
        return "table" if is_one_episode(path, parts) and not _holds_other_logs(path) else None
    if path.suffix.lower() in TABLES and path.exists():
        return "table"
    return "ros" if path.suffix.lower() in BAGS and path.exists() else None


def _holds_other_logs(folder: Path) -> bool:
    """Return whether a folder has logs beside its tables, which are then notes on these."""
    return any(log_kind(one) not in ((None,) if one.is_dir() else (None, "table")) for one in folder.iterdir())


def log_sources(source: Path | str | Sequence[Path | str], parts: Collection[str] = ()) -> list[Path]:
    """Return the logs that are meant: a folder that is no log stands for the logs in it, in the order of their names.

    Tables beside logs of another kind are notes on these, and left out. `parts` as in `is_one_episode`.

    Raises:
        RecordingError: None is named, or one is named twice.
    """
    named = [Path(source)] if isinstance(source, Path | str) else [Path(one) for one in source]
    found: list[Path] = []
    for path in named:
        inside = sorted(path.iterdir()) if path.is_dir() and log_kind(path, parts) is None else []
        kinds = {one: kind for one in inside if (kind := log_kind(one, parts)) is not None}
        found += [one for one, kind in kinds.items() if kind != "table"] or list(kinds) or [path]
    if not found:
        raise RecordingError("no log is named", expected=KINDS)
    resolved = [path.resolve() for path in found]
    if twice := [path for k, path in enumerate(found) if resolved.index(resolved[k]) < k]:
        raise RecordingError("a log is named twice", where=twice[0], fix="name it once")
    return found
