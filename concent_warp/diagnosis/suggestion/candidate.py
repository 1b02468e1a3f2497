"""Candidates for the next recording: one or more motions, and where they come from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from concent_warp.diagnosis.experiment.motions import ProposedMotion


@dataclass(frozen=True)
class Candidate:
    """What could be recorded next."""

    name: str
    """Kind of motion."""
    text: str
    """What to do, in words."""
    motions: tuple[ProposedMotion, ...]
    """Motions, each a demonstration of its own."""
    source: Literal["menu", "optimised", "random"]

    @property
    def duration(self) -> float:
        """Time that all motions take together [s]."""
        return sum(motion.duration for motion in self.motions)


def joined(candidates: Sequence[Candidate]) -> Candidate:
    """Return several candidates as one, their motions one after the other."""
    names = list(dict.fromkeys(one.name for one in candidates))
    motions = tuple(motion for one in candidates for motion in one.motions)
    return Candidate(" and ".join(names), "; then ".join(one.text for one in candidates), motions, candidates[0].source)
