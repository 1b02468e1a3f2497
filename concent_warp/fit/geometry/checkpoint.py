"""The state of a fit on disk: one ``.npz`` without pickles, written atomically."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.array_file import write_arrays
from concent_warp.errors import ModelError


@dataclass(frozen=True)
class Checkpoint:
    """All that a fit needs to go on as if it had not been interrupted."""

    cfg: dict[str, Any]
    start: np.ndarray
    """Sphere centres of the starting geometry [m], shape (S, 3): identifies the fit that the checkpoint belongs to."""
    mean: np.ndarray
    """Displacements of the estimate, shape (S, C)."""
    best_mean: np.ndarray
    """Displacements of the best estimate, shape (S, C)."""
    collidable: np.ndarray
    """Spheres in the physics of the search, shape (S,) bool."""
    frozen: np.ndarray
    """Spheres that the robot has touched, shape (S,) bool."""
    random_state: dict[str, Any]
    """State of the random generator."""
    numbers: dict[str, float]
    """Counters: generation, best, lowest, last_gain, simulations, seconds, sigma."""
    history: list[dict[str, Any]]
    stopped: str | None

    ARRAYS = ("start", "mean", "best_mean", "collidable", "frozen")
    TEXTS = ("cfg", "random_state", "numbers", "history", "stopped")

    def save(self, path: Path) -> None:
        """Write the checkpoint atomically."""
        path.parent.mkdir(parents=True, exist_ok=True)
        content: dict[str, Any] = {name: getattr(self, name) for name in self.ARRAYS}
        content |= {name: np.array(json.dumps(getattr(self, name))) for name in self.TEXTS}
        write_arrays(path, content)

    @staticmethod
    def load(path: Path) -> Checkpoint:
        """Read a checkpoint; raises `ModelError` where the file is not one."""
        try:
            with np.load(path, allow_pickle=False) as data:
                arrays = {name: data[name] for name in Checkpoint.ARRAYS}
                texts = {name: json.loads(str(data[name])) for name in Checkpoint.TEXTS}
        except Exception as error:  # NumPy, zipfile and json raise whatever their parsers do
            raise ModelError(
                "not a checkpoint of a fit", where=path, found=error, fix="delete it to start anew"
            ) from None
        return Checkpoint(**arrays, **texts)

    def check(self, cfg: dict[str, Any], start: np.ndarray) -> None:
        """Raise `ModelError` unless the checkpoint belongs to a fit of these settings and this starting geometry."""
        settled = json.loads(json.dumps(cfg))
        if differing := sorted(name for name in settled if settled[name] != self.cfg.get(name)):
            raise ModelError(
                "the checkpoint belongs to a fit with other settings",
                expected={name: settled[name] for name in differing},
                found={name: self.cfg.get(name) for name in differing},
                fix="repeat the settings, or start anew without --resume",
            )
        if not np.array_equal(self.start, start):
            raise ModelError("the checkpoint belongs to another starting geometry", fix="start anew without --resume")
