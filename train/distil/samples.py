"""The samples that a student learns from: the latest ones, in a ring on the device; in a file between checkpoints."""

from __future__ import annotations

from pathlib import Path

import torch

from concent_warp.errors import TrainError
from concent_warp.files import new_file

CHUNK = 4096
"""Samples that are written or read at once."""


class Samples:
    """A ring of samples: images, proprioception, the teacher's actions, poses of the objects."""

    def __init__(self, capacity: int, images: tuple[int, ...], widths: tuple[int, int, int], device: str) -> None:
        """Allocate the ring.

        Args:
            capacity: Most samples that are kept.
            images: Shape of the images of a sample, (C, 3 F, size, size).
            widths: Lengths of proprioception, action and poses of a sample.
            device: Torch's name of the device.

        Raises:
            TrainError: It does not fit the memory.
        """
        self.capacity, self.filled, self.next = capacity, 0, 0
        try:
            self.images = torch.empty(capacity, *images, dtype=torch.uint8, device=device)
        except RuntimeError:  # torch's out-of-memory errors are of this class, on CPU and GPU
            size = capacity * int(torch.tensor(images).prod())
            raise TrainError(
                "the samples do not fit the memory", where=device, found=f"{size / 1e9:.1f} GB",
                fix="lower --dagger.buffer or --images.size",
            ) from None  # fmt: skip
        self.proprioception, self.action, self.poses = (torch.zeros(capacity, width, device=device) for width in widths)

    def __len__(self) -> int:
        return self.filled

    def add(
        self, images: torch.Tensor, proprioception: torch.Tensor, action: torch.Tensor, poses: torch.Tensor
    ) -> None:
        """Add N samples, which take the place of the oldest ones where the ring is full; of too many, the first."""
        count = min(len(images), self.capacity)
        rows = (self.next + torch.arange(count, device=self.images.device)) % self.capacity
        parts = ((self.images, images), (self.proprioception, proprioception), (self.action, action))
        for kept, given in (*parts, (self.poses, poses)):
            kept[rows] = given[:count].to(kept.dtype)
        self.next = (self.next + count) % self.capacity
        self.filled = min(self.filled + count, self.capacity)

    def pick(self, count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return images, proprioception, actions and poses of `count` random samples."""
        rows = torch.randint(self.filled, (count,), device=self.images.device)
        return self.images[rows], self.proprioception[rows], self.action[rows], self.poses[rows]

    def save(self, path: Path) -> None:
        """Write the samples to a file atomically: the rows of each part one after the other, without a header."""
        with new_file(path) as partial, partial.open("wb") as file:
            for part in self._parts():
                for first in range(0, self.filled, CHUNK):
                    part[first : min(first + CHUNK, self.filled)].cpu().numpy().tofile(file)

    def load(self, path: Path, filled: int, following: int) -> None:
        """Read the samples that `save` wrote.

        Args:
            path: The file.
            filled: Number of samples in it.
            following: Row that the next sample takes.

        Raises:
            TrainError: The file is missing or has another size.
        """
        import numpy as np

        if not 0 <= filled <= self.capacity or not 0 <= following < self.capacity:
            raise TrainError("the checkpoint's samples do not fit", expected=self.capacity, found=(filled, following))
        expected = sum(filled * part[:1].numel() * part.element_size() for part in self._parts())
        found = path.stat().st_size if path.is_file() else None
        if found != expected:
            raise TrainError(
                "the samples of the training are not there", where=path, expected=f"{expected} bytes",
                found="no file" if found is None else f"{found} bytes", fix="start anew with --overwrite",
            )  # fmt: skip
        with path.open("rb") as file:
            for part in self._parts():
                kind = np.dtype("uint8" if part.dtype == torch.uint8 else "float32")
                for first in range(0, filled, CHUNK):
                    rows = part[first : min(first + CHUNK, filled)]
                    values = np.fromfile(file, kind, rows.numel()).reshape(tuple(rows.shape))
                    rows.copy_(torch.from_numpy(values))
        self.filled, self.next = filled, following

    def _parts(self) -> tuple[torch.Tensor, ...]:
        return self.images, self.proprioception, self.action, self.poses
