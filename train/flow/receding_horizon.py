"""Chunks in a closed loop: a policy predicts C actions, executes the first k of them, and looks again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from concent_warp.errors import TrainError
from concent_warp.train.flow.policy import Array, FlowPolicy


class RecedingHorizon:
    """Executes the chunks of a policy in N worlds, each with a horizon of its own.

    Example:
        >>> from concent_warp.train.flow.receding_horizon import RecedingHorizon
        >>> def loop(policy, camera, robot):
        ...     controller = RecedingHorizon(policy, "insert the peg")
        ...     while True:
        ...         robot.command(controller.act({"base": camera.read()[None]}, robot.state()[None])[0])
    """

    def __init__(self, policy: FlowPolicy, text: str | Sequence[str], *, execute: int | None = None) -> None:
        """Keep the policy.

        Args:
            policy: The policy.
            text: The instruction of all worlds, or one for each.
            execute: Actions of a chunk that are executed, 1 to the chunk's length; as in its settings by default.

        Raises:
            TrainError: The number of actions is out of bounds.
        """
        self.policy, self._text = policy, text
        self.execute = policy.cfg.execute if execute is None else execute
        if not 1 <= self.execute <= policy.cfg.chunk:
            raise TrainError(
                "the number of executed actions is out of bounds", expected=f"1 to {policy.cfg.chunk}", found=execute
            )
        self._chunks = np.zeros((0, policy.cfg.chunk, len(policy.features.action)), dtype=np.float32)
        self._next = np.zeros(0, dtype=int)

    def act(self, images: Mapping[str, Array], proprioception: Array, started: np.ndarray | None = None) -> np.ndarray:
        """Return the next action of each world, shape (N, A) float32; see `FlowPolicy.act`.

        Args:
            images: Present images by the names of the cameras, each (N, H, W, 3) uint8.
            proprioception: Present states of the robots, shape (N, P).
            started: Worlds in which an episode begins, whose chunk is dropped, shape (N,) bool; none by default.

        Raises:
            TrainError: An input is missing or has another shape or type.
        """
        count = len(proprioception)
        if len(self._chunks) != count:
            self._chunks = np.zeros((count, *self._chunks.shape[1:]), dtype=np.float32)
            self._next = np.full(count, self.execute)
        if started is not None:
            self._next[np.asarray(started, dtype=bool)] = self.execute
        rows = np.flatnonzero(self._next >= self.execute)
        if len(rows):
            text = self._text if isinstance(self._text, str) else [self._text[row] for row in rows.tolist()]
            seen = {name: images[name][_rows(rows, images[name])] for name in self.policy.features.cameras}
            own = proprioception[_rows(rows, proprioception)]
            self._chunks[rows], self._next[rows] = self.policy.act(seen, own, text), 0
        found = self._chunks[np.arange(count), self._next]
        self._next += 1
        return found


def _rows(rows: np.ndarray, of: Array) -> np.ndarray | torch.Tensor:
    """Return rows as they index an array, or a tensor on its device."""
    return torch.as_tensor(rows, device=of.device) if isinstance(of, torch.Tensor) else rows
