"""A training by several processes side by side, each with worlds of its own and all with one policy.

``torchrun`` starts the processes and numbers them. Gradients, normalisation and what is logged are averaged over all of
them through `torch.distributed`, so that N processes of M worlds train as one of N x M would.
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

from concent_warp.errors import ConcentError, TrainError


@dataclass(frozen=True)
class Ranks:
    """This process among those of a training; alone by default."""

    rank: int = 0
    """Number of this process; the first one writes files and talks."""
    count: int = 1
    """How many there are."""
    local: int = 0
    """Number of this process on its host, and of its GPU."""
    on_host: int = 1
    """How many there are on this host."""

    @staticmethod
    def here() -> Ranks:
        """Return this process as ``torchrun`` numbered it, alone where it was not started by it."""
        if "TORCHELASTIC_RUN_ID" not in os.environ:
            return Ranks()
        names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
        return Ranks(*(int(os.environ[name]) for name in names))

    @property
    def first(self) -> bool:
        """Whether this is the process that writes."""
        return self.rank == 0

    @property
    def alone(self) -> bool:
        """Whether there is no other."""
        return self.count == 1

    def device(self, wanted: str | None = None) -> str:
        """Return Warp's name of this process's device: of several processes each has a GPU of its own.

        Args:
            wanted: "cpu", "cuda" or, of a single process, a GPU by its number; GPUs by default where there are any.

        Raises:
            TrainError: There are more processes than GPUs, or one GPU is wanted for several processes.
        """
        found = torch.cuda.device_count()
        if self.alone:
            return wanted or ("cuda:0" if found else "cpu")
        if wanted not in (None, "cpu", "cuda"):
            raise TrainError("each process takes a GPU of its own", expected="--device cuda or cpu", found=wanted)
        if wanted == "cpu" or (wanted is None and not found):
            return "cpu"
        if self.on_host > found:
            raise TrainError(
                "there are more processes than GPUs",
                expected=f"at most {found}",
                found=self.on_host,
                fix="start fewer with torchrun's --nproc-per-node, or have them share the CPU with --device cpu",
            )
        return f"cuda:{self.local}"

    def seed(self, seed: int) -> int:
        """Return the seed of this process's worlds: the given one for the first, others for the others."""
        return seed if self.first else int(np.random.SeedSequence([seed, self.rank]).generate_state(1)[0])

    @contextmanager
    def joined(self, device: str) -> Iterator[None]:
        """Have the processes talk to one another while they train on their devices."""
        if self.alone:
            yield
            return
        if device.startswith("cuda"):
            import warp as wp

            torch.cuda.set_device(self.local)
            wp.set_device(device)
        distributed.init_process_group("nccl" if device.startswith("cuda") else "gloo")
        try:
            yield
        finally:
            distributed.destroy_process_group()

    def rsl_rl(self) -> dict[str, int] | None:
        """Return what rsl-rl wants to know of this."""
        return None if self.alone else {"global_rank": self.rank, "local_rank": self.local, "world_size": self.count}

    def total(self, values: torch.Tensor) -> torch.Tensor:
        """Return the sum of tensors over all processes, on the device that they are on."""
        if not self.alone:
            distributed.all_reduce(values)
        return values

    def gathered(self, value: Any) -> list[Any]:
        """Return what each process gives, in their order."""
        if self.alone:
            return [value]
        found: list[Any] = [None] * self.count
        distributed.all_gather_object(found, value)
        return found

    @contextmanager
    def agreeing(self) -> Iterator[None]:
        """Run a part of the preparations; where it fails for one process, it fails for all.

        Raises:
            ConcentError: What this process raised, or the first of the others'.
        """
        error: ConcentError | None = None
        try:
            yield
        except ConcentError as raised:
            error = raised
        others = [text for text in self.gathered(None if error is None else str(error)) if text is not None]
        if error is not None:
            raise error
        if others:
            raise TrainError(others[0])

    @contextmanager
    def interruptions(self) -> Iterator[Callable[[], bool]]:
        """Give what tells whether any process was asked to stop; all are to ask it at the same place.

        Several processes must not stop in the midst of a round, where others wait for them. Alone, an interruption is
        raised at once, as ever.
        """
        if self.alone:
            yield lambda: False
            return
        asked = False

        def note(number: int, frame: object) -> None:
            del number, frame
            nonlocal asked
            asked = True

        before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield lambda: any(self.gathered(asked))
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
