"""Policies that come with the package, by name: reduced run folders in `train/pretrained`."""

from __future__ import annotations

from pathlib import Path

from concent_warp.errors import TrainError
from concent_warp.train.learning.ppo import CHECKPOINT

FOLDER = Path(__file__).parents[1] / "pretrained"
ORIGIN = "origin.toml"
"""File that says where a policy comes from; a folder that holds one holds a pretrained policy."""


def names() -> list[str]:
    """Return the names of the policies that come with the package."""
    return sorted(path.parent.name for path in FOLDER.glob(f"*/{ORIGIN}"))


def pretrained_checkpoint(name: str) -> Path:
    """Return the checkpoint of a policy that comes with the package.

    Raises:
        TrainError: There is none of that name.
    """
    if name not in names():
        raise TrainError("no such policy comes with the package", expected=f"one of {names()}", found=name)
    return FOLDER / name / CHECKPOINT
