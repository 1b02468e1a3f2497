"""Pretrained policies of the package by name: reduced run folders in `train/pretrained`."""

from __future__ import annotations

from pathlib import Path

from concent_warp.errors import TrainError
from concent_warp.run_folder import TRAIN_CHECKPOINT

FOLDER = Path(__file__).parents[1] / "pretrained"
ORIGIN = "origin.toml"
"""File with command and versions of the training; it marks the folder of a pretrained policy."""


def pretrained_names() -> list[str]:
    """Return the names of the pretrained policies."""
    return sorted(path.parent.name for path in FOLDER.glob(f"*/{ORIGIN}"))


def pretrained_checkpoint(name: str) -> Path:
    """Return the checkpoint file of a pretrained policy.

    Raises:
        TrainError: The name is unknown.
    """
    if name not in pretrained_names():
        raise TrainError("no such policy comes with the package", expected=f"one of {pretrained_names()}", found=name)
    return FOLDER / name / TRAIN_CHECKPOINT
