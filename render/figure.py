"""The decomposition of the hybrid image, as the paper shows it: a row for each sample, a column for each layer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from concent_warp.errors import RenderError
from concent_warp.files import new_file
from concent_warp.render.composite import Layers

COLUMNS = ("raw simulation", "hybrid composite", "robot and background", "objects", "object shadows")


class FrameSelection:
    """Some frames of an episode, spread over it, however long it becomes."""

    def __init__(self, shares: Sequence[float] = (0.3, 0.8), max_frames: int = 8) -> None:
        """Select frames by their positions in the episode, as shares of its length, from at most `max_frames`."""
        self._max_frames = max_frames
        self._shares, self._every, self._count = tuple(shares), 1, 0
        self._kept: list[tuple[int, Layers]] = []

    def __len__(self) -> int:
        """Return the number of frames that it has seen."""
        return self._count

    def add(self, layers: Layers, world: int = 0) -> None:
        """Add the next frame."""
        if self._count % self._every == 0:
            self._kept.append((self._count, layers.clone(world)))
            if len(self._kept) > self._max_frames:
                self._kept, self._every = self._kept[::2], 2 * self._every
        self._count += 1

    def chosen(self) -> list[Layers]:
        """Return the frames nearest to the shares.

        Raises:
            RenderError: There were no frames.
        """
        if not self._kept:
            raise RenderError("there is no frame to show")
        instants = [share * (self._count - 1) for share in self._shares]
        return [min(self._kept, key=lambda kept, at=at: abs(kept[0] - at))[1] for at in instants]


def decomposition(samples: Sequence[Layers], cameras: Sequence[str], path: Path) -> None:
    """Write the figure: for each camera, a row for each sample (paper, figure of appendix E).

    Args:
        samples: Layers of one world each.
        cameras: Names of the cameras.
        path: File to write, .png or .pdf.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = [(c, sample) for c in range(len(cameras)) for sample in samples]
    figure = Figure(figsize=(2.1 * len(COLUMNS), 2.1 * len(rows) + 0.25), layout="constrained", dpi=120)
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(rows), len(COLUMNS), squeeze=False)
    for r, (c, sample) in enumerate(rows):
        for k, picture in enumerate(_columns(sample, c)):
            axis = axes[r, k]
            axis.imshow(picture)
            axis.set_xticks([])
            axis.set_yticks([])
            if r == 0:
                axis.set_title(COLUMNS[k], fontsize=9)
            if k == 0:
                axis.set_ylabel(f"{cameras[c]} camera", fontsize=9)
    with new_file(path) as partial:
        figure.savefig(partial, format=path.suffix.lstrip(".") or "png")


def _columns(sample: Layers, camera: int) -> list[np.ndarray]:
    """Return the pictures of a row, each shape (H, W, 3), 0..1: objects and shadows on white."""
    alpha = sample.alpha[0, camera, ..., None]
    objects = sample.objects[0, camera] + (1 - alpha)
    shadow = (1 - sample.shadow[0, camera, ..., None]).expand(-1, -1, 3)
    pictures = (sample.raw[0, camera], sample.image[0, camera], sample.background[0, camera], objects, shadow)
    return [torch.clamp(picture, 0, 1).numpy() for picture in pictures]
