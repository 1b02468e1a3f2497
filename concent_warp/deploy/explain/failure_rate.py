"""How often a policy fails in the trials, and in its own simulation from such starts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from scipy.stats import fisher_exact

from concent_warp.deploy.explain.cfg import JudgeCfg


@dataclass(frozen=True)
class FailureRates:
    """Failures among all trials, and among episodes of the policy's own simulation from the starts of some of them."""

    failed: int
    """Trials that failed."""
    trials: int
    """All trials."""
    simulated_failed: int
    """Simulated episodes that failed."""
    simulated: int
    """All simulated episodes."""

    @property
    def rate(self) -> float:
        """Share of the trials that failed."""
        return self.failed / self.trials

    @property
    def simulated_rate(self) -> float:
        """Share of the simulated episodes that failed."""
        return self.simulated_failed / self.simulated

    def agree(self, cfg: JudgeCfg) -> bool:
        """Return whether the policy fails about as often in its own simulation.

        It does where failures are not significantly more frequent in the trials, by Fisher's exact test, and the rate
        of the simulation is a relevant share of theirs: few trials alone would never be significant.
        """
        if not self.simulated_failed or self.simulated_rate < cfg.least_failures * self.rate:
            return False
        counts = [
            [self.failed, self.trials - self.failed],
            [self.simulated_failed, self.simulated - self.simulated_failed],
        ]
        found: Any = fisher_exact(counts, alternative="greater")
        return bool(found.pvalue > cfg.significance)

    @property
    def sentence(self) -> str:
        """A sentence on both rates."""
        return (
            f"{self.failed} of {self.trials} trials failed; from starts of trials that were drawn from all of them the "
            f"policy fails in {self.simulated_failed} of {self.simulated} episodes of its own simulation."
        )
