"""Images of the worlds of an environment: the protocol of what renders, and the delay of cameras."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch

from concent_warp.train.environment.environment import Environment


class ImageSource(Protocol):
    """Cameras in the N worlds of an environment."""

    cameras: tuple[str, ...]
    """Names of the C cameras."""
    size: int
    """Height and width of an image [px]."""

    def begin(self, which: torch.Tensor) -> None:
        """Begin episodes in the worlds of a mask (N,) bool: whatever is random about the images is sampled anew."""
        ...

    def render(self, qpos: torch.Tensor, mocap: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """Return what the cameras see, uint8, shape (N, C, 3, size, size), not to be written to.

        Args:
            qpos: Positions, shape (N, nq).
            mocap: Positions [m] (N, nmocap, 3) and orientations wxyz (N, nmocap, 4) of fixed objects.
        """
        ...

    def state(self) -> dict[str, torch.Tensor]:
        """Return by name what lasts for an episode, for checkpoints."""
        ...

    def restore(self, state: dict[str, torch.Tensor]) -> None:
        """Set the state that `state` returned."""
        ...


MakeImages = Callable[[Environment], ImageSource]
"""Makes the cameras of an environment's worlds."""


class DelayedImages:
    """Latest images of N worlds, each seen with a delay of its own that lasts for an episode."""

    def __init__(self, source: ImageSource, frames: int, delay: tuple[int, int]) -> None:
        """Keep what renders.

        Args:
            source: The cameras.
            frames: Successive images that are seen at once.
            delay: Least and largest delay [control steps].
        """
        self.source, self._frames, self._range = source, frames, delay
        self._kept: torch.Tensor | None = None
        self._delay = torch.zeros(0, dtype=torch.long)

    def look(
        self, environment: Environment, started: torch.Tensor, renewed: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Return what is seen of the present states, uint8, shape (N, C, 3 F, size, size), the latest image first.

        Args:
            environment: The worlds.
            started: Worlds in which an episode begins, shape (N,) bool; before it, all was as it is.
            renewed: Worlds whose random looks are sampled anew besides, shape (N,) bool.
        """
        self.source.begin(started if renewed is None else started | renewed)
        present = self.source.render(environment.physics.qpos, environment.physics.mocap)
        low, high = self._range
        length = high + self._frames
        if self._kept is None:
            self._kept = present[None].repeat(length, *[1] * present.ndim)
            self._delay = torch.zeros(len(present), dtype=torch.long, device=present.device)
        started = started.to(present.device)
        delay = torch.randint(low, high + 1, self._delay.shape, device=present.device)
        self._delay = torch.where(started, delay, self._delay)
        fresh = started.view(1, -1, *[1] * (present.ndim - 1))
        self._kept[1:] = torch.where(fresh, present[None], self._kept[:-1].clone())
        self._kept[0] = present
        worlds = torch.arange(len(present), device=present.device)
        seen = [self._kept[self._delay + k, worlds] for k in range(self._frames)]
        return seen[0] if len(seen) == 1 else torch.cat(seen, dim=2)

    def state(self) -> dict[str, torch.Tensor]:
        """Return the kept images and the delays by name, for checkpoints; empty before the first look."""
        return {} if self._kept is None else {"images": self._kept.clone(), "delay": self._delay.clone()}

    def restore(self, state: dict[str, torch.Tensor], device: str) -> None:
        """Set the state that `state` returned."""
        if state:
            self._kept, self._delay = state["images"].to(device), state["delay"].to(device)
