"""Distributed data-parallel training: each process simulates its own worlds, all train one policy.

``torchrun`` starts the processes. Gradients, observation statistics and metrics are averaged over the ranks by
`torch.distributed`, so that N processes of M worlds train as one process of N x M worlds does.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import distributed

from concent_warp.checks import check_device
from concent_warp.errors import ConcentError, TrainError


@dataclass(frozen=True)
class DistributedProcess:
    """One process of a distributed data-parallel training; by default the only one."""

    rank: int = 0
    """Global rank; rank 0 writes files and reports progress."""
    world_size: int = 1
    """Number of processes."""
    local_rank: int = 0
    """Rank on this host, and index of its GPU."""
    local_world_size: int = 1
    """Number of processes on this host."""

    @staticmethod
    def from_environment() -> DistributedProcess:
        """Return the process that ``torchrun``'s environment variables describe, a single one without them."""
        if "TORCHELASTIC_RUN_ID" not in os.environ:
            return DistributedProcess()
        names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
        return DistributedProcess(*(int(os.environ[name]) for name in names))

    @property
    def is_rank_zero(self) -> bool:
        """Whether this process writes files and reports progress."""
        return self.rank == 0

    @property
    def is_single(self) -> bool:
        """Whether the training has one process."""
        return self.world_size == 1

    def device(self, wanted: str | None = None) -> str:
        """Return Warp's name of this process's device; each rank has a GPU of its own.

        Args:
            wanted: "cpu", "cuda" or, in training with a single process, a GPU by its index; by default GPUs if present.

        Raises:
            TrainError: There are more processes than GPUs, or one GPU is requested for several processes.
            ConcentError: There is no such device.
        """
        found = torch.cuda.device_count()
        if self.is_single:
            check_device(wanted)
            return wanted or ("cuda:0" if found else "cpu")
        if wanted not in (None, "cpu", "cuda"):
            raise TrainError("each process uses its own GPU", expected="--device cuda or cpu", found=wanted)
        if wanted == "cpu" or (wanted is None and not found):
            return "cpu"
        if self.local_world_size > found:
            raise TrainError(
                "there are more processes than GPUs",
                expected=f"at most {found}",
                found=self.local_world_size,
                fix="lower torchrun's --nproc-per-node, or train on the CPU with --device cpu",
            )
        return f"cuda:{self.local_rank}"

    def seed(self, seed: int) -> int:
        """Return the seed of this process's worlds: the given seed on rank 0, one derived from it on other ranks."""
        return seed if self.is_rank_zero else int(np.random.SeedSequence([seed, self.rank]).generate_state(1)[0])

    @contextmanager
    def group(self, device: str) -> Iterator[None]:
        """Join the process group of `torch.distributed` within the context: NCCL on GPUs, Gloo on the CPU."""
        if self.is_single:
            yield
            return
        if device.startswith("cuda"):
            import warp as wp

            torch.cuda.set_device(self.local_rank)
            wp.set_device(device)
        distributed.init_process_group("nccl" if device.startswith("cuda") else "gloo")
        try:
            yield
        finally:
            distributed.destroy_process_group()

    def rsl_rl(self) -> dict[str, int] | None:
        """Return rsl-rl's ``multi_gpu`` settings, None for a single process."""
        if self.is_single:
            return None
        return {"global_rank": self.rank, "local_rank": self.local_rank, "world_size": self.world_size}

    def sum_over_ranks(self, values: torch.Tensor) -> torch.Tensor:
        """Return the elementwise sum of the ranks' tensors, in place, shape of `values`."""
        if not self.is_single:
            distributed.all_reduce(values)
        return values

    def gather(self, value: Any) -> list[Any]:
        """Return the values of all ranks, in the order of ranks."""
        if self.is_single:
            return [value]
        found: list[Any] = [None] * self.world_size
        distributed.all_gather_object(found, value)
        return found

    @contextmanager
    def raise_together(self) -> Iterator[None]:
        """Raise an error of the context's body on every rank, so that no rank waits for one that failed.

        Raises:
            ConcentError: The error of this rank, or else the first of another rank.
        """
        error: ConcentError | None = None
        try:
            yield
        except ConcentError as raised:
            error = raised
        others = [text for text in self.gather(None if error is None else str(error)) if text is not None]
        if error is not None:
            raise error
        if others:
            raise TrainError(others[0])

    @contextmanager
    def watch_interrupts(self) -> Iterator[Callable[[], bool]]:
        """Yield a function that returns whether any rank received SIGINT or SIGTERM; a collective call.

        With several processes a signal takes effect at the next call, since a rank that stops within an iteration
        would leave the others waiting. In a single process the signal raises at once and the function returns False.
        """
        if self.is_single:
            yield lambda: False
            return
        received = False

        def handle(number: int, frame: object) -> None:
            del number, frame
            nonlocal received
            received = True

        before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield lambda: any(self.gather(received))
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
