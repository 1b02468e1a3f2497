"""Poses of cameras from a tree of coordinate frames, as tf_static has it."""

from __future__ import annotations

import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.recording.logs.readers.log import Transforms


def transform(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Return the transform (4, 4) of a position (3,) [m] and a quaternion (4,), wxyz."""
    w, x, y, z = np.asarray(quaternion, dtype=float) / max(float(np.linalg.norm(quaternion)), 1e-12)
    found = np.eye(4)
    found[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    found[:3, 3] = position
    return found


def pose_between(tree: Transforms, frame: str, reference: str, where: object) -> np.ndarray:
    """Return the transform (4, 4) from a frame to a reference frame, both fixed to one another.

    Raises:
        RecordingError: A frame is unknown, they are not connected, or something between them moves.
    """
    down, up = _chain(tree, frame), _chain(tree, reference)
    known = {*tree.parents, *(parent for parent, _ in tree.parents.values())}
    for name in (frame, reference):
        if name not in known:
            raise RecordingError(
                "no such frame in the transforms of the log", where=where, expected=f"one of {sorted(known)}",
                found=repr(name), fix="record /tf_static, or state the camera's pose in the map",
            )  # fmt: skip
    shared = next((name for name in down if name in up), None)
    if shared is None:
        fix = "record all of /tf_static, or state the camera's pose in the map"
        raise RecordingError(f"frames {frame!r} and {reference!r} are not connected", where=where, fix=fix)
    between = [*down[: down.index(shared)], *up[: up.index(shared)]]
    if moving := [name for name in between if name in tree.moving]:
        fix = "name the body that carries the camera with `body`, and its frame with `reference`"
        raise RecordingError(f"frame {frame!r} moves in {reference!r}", where=where, found=f"{moving} in /tf", fix=fix)
    return np.linalg.inv(_to_root(tree, up[: up.index(shared)])) @ _to_root(tree, down[: down.index(shared)])


def _chain(tree: Transforms, frame: str) -> list[str]:
    """Return a frame and its ancestors; a circle ends where it closes."""
    found = [frame]
    while (above := tree.parents.get(found[-1])) and above[0] not in found:
        found.append(above[0])
    return found


def _to_root(tree: Transforms, frames: list[str]) -> np.ndarray:
    """Return the transform from the first of some frames, each the child of the next, to the last one's parent."""
    found = np.eye(4)
    for name in frames:
        found = tree.parents[name][1] @ found
    return found
