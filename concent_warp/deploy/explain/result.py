"""Why trials of a policy failed: the cause, its evidence, and what mends it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from concent_warp.comparison.result import finite
from concent_warp.deploy.explain.pose_bias import PoseBias
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.recording.recording import Recording

Cause = Literal["perception", "physics", "policy", "unexplained"]
CAUSES: dict[Cause, str] = {
    "perception": "perception: the objects are not where the tracker shows them",
    "physics": "physics: the real world moves otherwise than the model",
    "policy": "policy: it fails in its own simulation, too",
    "unexplained": "unexplained: the policy's own simulation agrees with the trials and succeeds from the same starts, "
    "or no cause explains enough of the difference",
}


@dataclass(frozen=True)
class TrialExplanation:
    """Why one trial failed.

    Example:
        >>> import concent_warp as cw
        >>> trial = cw.TrialExplanation("demo_0", "trials.h5", "policy", 2.5, None, "It fails in simulation too.", {})
        >>> trial.cause, trial.to_json()["moment"]
        ('policy', 2.5)
    """

    name: str
    """Name of the trial in its recording."""
    source: str
    """The recording."""
    cause: Cause
    moment: float | None
    """First time at which the model, replaying the commands, differs from the measurements beyond what its own trials
    show [s]; where it never does, the time after which the object came no nearer to its place. None if unknown."""
    left_prediction: float | None
    """First time at which the object was outside the band of the policy's own simulated episodes [s]; None if never."""
    sentence: str
    evidence: Mapping[str, float | None]
    """Numbers by name, see docs/explain.md."""
    divergence: np.ndarray = field(default_factory=lambda: np.zeros(0), repr=False)
    """Error of the replay over noise in each window, shape (W,)."""
    threshold: float = 0.0
    """The same up to which a window agrees."""
    window: float = 0.25
    """Length of a window [s]."""
    start: np.ndarray = field(default_factory=lambda: np.zeros(0), repr=False)
    """State that it was replayed from, shape (nq,)."""

    def to_json(self) -> dict[str, Any]:
        """Return the explanation in plain types."""
        return {
            "trial": self.name,
            "source": self.source,
            "cause": self.cause,
            "moment": self.moment,
            "left_prediction": self.left_prediction,
            "sentence": self.sentence,
            "evidence": finite(dict(self.evidence)),
            "divergence": finite(self.divergence.tolist()),
            "threshold": self.threshold,
        }


@dataclass(frozen=True)
class Explanation:
    """Why trials of a policy failed, judged one by one and all together.

    Example:
        >>> import concent_warp as cw
        >>> explanation = cw.Explanation("policy", (), 3, 20, {}, ("It fails in simulation too.",), ())
        >>> explanation.headline, explanation.effects
        ('policy: it fails in its own simulation, too', ())
    """

    cause: Cause
    """The cause that all trials together show."""
    trials: tuple[TrialExplanation, ...]
    """Failed trials that were explained."""
    failed: int
    """Failed trials in the recordings."""
    total: int
    """All trials in the recordings."""
    evidence: Mapping[str, float | None]
    """Numbers by name, see docs/explain.md."""
    remarks: tuple[str, ...]
    """Sentences on the evidence."""
    remedy: tuple[str, ...]
    """Commands that mend the cause, each after a comment."""
    diagnosis: Diagnosis | None = field(default=None, repr=False)
    """Which effect is missing; None where none was searched for."""
    bias: PoseBias | None = field(default=None, repr=False)
    """The error of tracked poses that explains most; None where none was searched for."""
    simulated: Recording | None = field(default=None, repr=False)
    """Episodes of the policy's own simulation from the starts of the trials, for the page."""

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the missing effects; of those that the data cannot distinguish the first one."""
        if self.diagnosis is None or self.cause not in ("physics", "perception"):
            return ()
        return tuple(finding.name for finding in self.diagnosis.accepted)

    @property
    def headline(self) -> str:
        """The cause in words."""
        return CAUSES[self.cause]

    def sentences(self) -> list[str]:
        """Return the result in sentences."""
        count = len(self.trials)
        shares = ", ".join(
            f"{n} {cause}" for cause in CAUSES if (n := sum(trial.cause == cause for trial in self.trials))
        )
        one_by_one = f"{count} of {self.failed} failed trials, one by one: {shares}."
        return [*self.remarks, one_by_one]

    def to_json(self) -> dict[str, Any]:
        """Return the explanation in plain types, as documented in ``docs/explain.md``."""
        bias = self.bias
        return {
            "cause": self.cause,
            "failed": self.failed,
            "total": self.total,
            "evidence": finite(dict(self.evidence)),
            "effects": list(self.effects),
            "groups": [] if self.diagnosis is None else [list(group) for group in self.diagnosis.groups],
            "bias": None
            if bias is None
            else {
                "position": bias.value[:3].tolist(),
                "rotation": bias.value[3:].tolist(),
                "std": bias.std.tolist(),
            },
            "remarks": list(self.remarks),
            "remedy": list(self.remedy),
            "trials": [trial.to_json() for trial in self.trials],
            "diagnosis": None if self.diagnosis is None else self.diagnosis.to_json(),
        }
