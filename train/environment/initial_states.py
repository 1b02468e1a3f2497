"""Initial states of episodes: those sampled before training, and those in which worlds got stuck during it.

A policy meets few of the states in which it fails, since each episode that gets there ends soon after. States in which
progress stopped are kept, and some later episodes start from them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from concent_warp.train.reset_cfg import StuckCfg
from concent_warp.train.resets.reset_states import ResetStates


class InitialStates:
    """Initial states of N worlds, and a ring buffer of stuck states; its operations can be captured in CUDA graphs."""

    def __init__(self, states: ResetStates, cfg: StuckCfg, worlds: int, device: str, control_step: float) -> None:
        """Copy the states to the device.

        Args:
            states: States sampled before training.
            cfg: When a world is stuck, and how many such states are kept.
            worlds: N.
            device: Torch's name of the device.
            control_step: Time between actions [s].
        """
        self._cfg, self._after = cfg, max(1, round(cfg.after / control_step))
        self._sampled, self._room = len(states.qpos), cfg.states if cfg.share > 0 else 0

        def real(values: Any) -> torch.Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=device)

        stage = torch.as_tensor(np.asarray(states.stage), dtype=torch.int32, device=device)
        parts = [real(v) for v in (states.qpos, states.qvel, states.ctrl, states.mocap[..., :3], states.mocap[..., 3:])]
        # The last row takes what is not to be kept, so that writing needs no selection of rows.
        self._pool = [torch.cat([part, part.new_zeros(self._room + 1, *part.shape[1:])]) for part in (*parts, stage)]
        self._begins = torch.zeros(self._sampled + self._room + 1, dtype=torch.bool, device=device)
        self._begins[: self._sampled] = torch.as_tensor(states.begins, device=device)
        self._stored = torch.zeros((), dtype=torch.long, device=device)
        self._best = torch.full((worlds,), torch.inf, device=device)
        self._waited = torch.zeros(worlds, dtype=torch.int32, device=device)
        self._stage = torch.full((worlds,), -1, dtype=torch.int32, device=device)

    @property
    def memory(self) -> dict[str, torch.Tensor]:
        """State by name, for checkpoints."""
        if not self._room:
            return {}
        names = ("qpos", "qvel", "ctrl", "mocap position", "mocap quaternion", "stage")
        stuck = {name: part[self._sampled :] for name, part in zip(names, self._pool, strict=True)}
        own = {"stored": self._stored, "best distance": self._best, "waited": self._waited, "of stage": self._stage}
        return {f"stuck {name}": value for name, value in (stuck | own).items()}

    def sample(self, success: torch.Tensor) -> torch.Tensor:
        """Return random rows for N episodes, shape (N,).

        Args:
            success: Present success rate, shape (); stuck states are as frequent as `StuckCfg.share` times it, so that
                a policy learns the task first.
        """
        chances = torch.rand(2, len(self._best), device=self._best.device)
        rows = (chances[1] * self._sampled).long().clamp(max=self._sampled - 1)
        if not self._room:
            return rows
        kept = self._stored.clamp(max=self._room)
        stuck = self._sampled + torch.minimum((chances[1] * kept).long(), (kept - 1).clamp(min=0))
        return torch.where((chances[0] < self._cfg.share * success) & (kept > 0), stuck, rows)

    def at(self, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return qpos, qvel, ctrl, positions and orientations of fixed objects, stage, and whether the state is before
        the first stage, of rows (N,).
        """
        return tuple(part[rows] for part in (*self._pool, self._begins))

    def forget_progress(self, mask: torch.Tensor) -> None:
        """Let progress count anew in the worlds of a mask (N,) bool, where episodes start."""
        self._best.masked_fill_(mask, torch.inf)
        self._waited.masked_fill_(mask, 0)

    def keep_stuck(
        self, state: tuple[torch.Tensor, ...], distance: torch.Tensor, moving: torch.Tensor, counts: torch.Tensor
    ) -> None:
        """Store the states of worlds whose distance to the target has not decreased for `StuckCfg.after`.

        The progress of a world whose stage is another than before counts from then on.

        Args:
            state: Parts as `at` returns them, but for the last, with N rows each.
            distance: To the target [m], shape (N,).
            moving: Worlds in which the target is neither met nor the episode over, shape (N,) bool; of others the
                earlier distances are forgotten.
            counts: Factor of 0 or 1, shape (): whether states are stored now.
        """
        if not self._room:
            return
        stage = state[-1]
        better = (distance < self._best - self._cfg.gain) | (stage != self._stage)
        self._stage.copy_(stage)
        self._best.copy_(torch.where(moving, torch.where(better, distance, self._best), torch.inf))
        self._waited.copy_(torch.where(moving & ~better, self._waited + 1, 0))
        stuck = (self._waited == self._after) & (distance < self._cfg.within) & (counts > 0)
        place = (self._stored + stuck.cumsum(0) - 1) % self._room
        rows = self._sampled + torch.where(stuck, place, self._room)
        for kept, value in zip(self._pool, state, strict=True):
            kept.index_copy_(0, rows, value.to(kept.dtype))
        self._stored += stuck.sum()
