"""Sums over the steps of an environment, and the means of its log."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

TERMS = ("reach", "stages", "action", "velocity", "press", "disturb", "vcp", "failure")
"""Terms of the reward, in the order of `Environment.terms`."""
EPISODE_SUMS = ("episodes", "success", "time outs", "dropped", "severe", "diverged", "return", "length")
CHAIN_SUMS = ("chains", "chain success")
"""Sums over episodes that started before the first stage; the number that met each stage's target follows."""


class StepLog:
    """Sums on the device; adding to them can be captured in a CUDA graph."""

    def __init__(self, stages: Sequence[str], *, is_chain: bool, device: str) -> None:
        """Start at 0; `stages` are the names of the trained ones."""
        self.names = (*TERMS, "steps", *EPISODE_SUMS, *CHAIN_SUMS, *(f"met {name}" for name in stages), "overflow")
        self.sums = torch.zeros(len(self.names), dtype=torch.float64, device=device)
        """Shape (len(names),)."""
        self._is_chain = is_chain

    def add(
        self,
        terms: torch.Tensor,
        ended: torch.Tensor,
        outcomes: Sequence[torch.Tensor],
        sums: Sequence[torch.Tensor],
        counts: Sequence[torch.Tensor],
    ) -> None:
        """Add a step of N worlds.

        Args:
            terms: Weighted terms of the reward, shape (N, len(TERMS)).
            ended: 1 where an episode ended, else 0, shape (N,).
            outcomes: Episodes that ended so, in the order of `EPISODE_SUMS`, shape (N,) bool each.
            sums: Return and length of the ended episodes, shape () each.
            counts: What is counted in chains, in the order of the names, and overflow, shape (N,) bool each.
        """
        parts = [*terms.double().sum(dim=0).unbind(), (ended * 0 + 1).sum(), ended.sum()]
        parts += [outcome.double().sum() for outcome in outcomes]
        self.sums += torch.stack([*parts, *sums, *(count.double().sum() for count in counts)])

    def read(self, total: Callable[[torch.Tensor], torch.Tensor] | None = None) -> dict[str, float]:
        """Return means and set the sums to 0; see `Environment.read_log`."""
        values = self.sums.clone() if total is None else total(self.sums.clone())
        sums = dict(zip(self.names, values.tolist(), strict=True))
        self.sums.zero_()
        per = dict.fromkeys((*TERMS, "overflow"), "steps")
        per |= {name: "chains" for name in self.names if name.startswith(("met ", "chain "))}
        means = {name: value / max(sums[per.get(name, "episodes")], 1.0) for name, value in sums.items()}
        chained = {name: means.pop(name) for name in self.names if name == "chains" or per.get(name) == "chains"}
        if self._is_chain:
            success, means["success of all"] = chained.pop("chain success"), means["success"]
            means |= {**chained, "success": success, "chains": sums["chains"]}
        return {**means, "steps": sums["steps"], "episodes": sums["episodes"], "diverged worlds": sums["diverged"]}
