"""Which kind of log a path is, from names alone."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

LogKind = Literal["lerobot", "ros", "images"]
KINDS = (
    "a LeRobot v3 data set (folder with meta/info.json), an MCAP file (.mcap), a ROS bag (.bag, .db3, or folder with "
    "metadata.yaml), or a folder with intrinsics.json and folders of colour and depth images"
)
BAGS = (".mcap", ".bag", ".db3")
COLOUR_FOLDERS = ("color", "colour", "rgb", "image", "images", "left")
DEPTH_FOLDERS = ("depth", "aligned_depth", "aligned_depth_to_color", "depth_aligned")
INTRINSICS = ("intrinsics.json", "camera_intrinsic.json", "intrinsic.json", "camera_intrinsics.json")


def log_kind(path: Path) -> LogKind | None:
    """Return the kind of log that a file or folder is, None for none that is known."""
    if path.is_dir():
        if (path / "meta" / "info.json").exists():
            return "lerobot"
        if (path / "metadata.yaml").exists():
            return "ros"
        folders = {one.name.lower() for one in path.iterdir() if one.is_dir()}
        if folders & {*COLOUR_FOLDERS, *DEPTH_FOLDERS} or any((path / name).exists() for name in INTRINSICS):
            return "images"
        return None
    return "ros" if path.suffix.lower() in BAGS and path.exists() else None
