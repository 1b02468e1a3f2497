"""What a search for missing effects has found so far."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np

from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel
from concent_warp.diagnosis.constants import FinerTimeStep, HoldingConstraint
from concent_warp.diagnosis.result import Finding
from concent_warp.diagnosis.search.reconsider import Rival
from concent_warp.fit.effects.intervals import FittedParameter
from concent_warp.model import Model

EXPLAINS_LESS = "another one explains more"
"""Reason for which an effect is not accepted."""
ALIKE = "the data cannot distinguish it from the accepted one"
"""Reason for which another one of a group is not."""


class Constants(NamedTuple):
    """Constants of the simulator that are other ones than as given; see `SearchRecord`."""

    time_step: FinerTimeStep | None
    holding: tuple[HoldingConstraint, ...]
    held_first: int


@dataclass
class SearchRecord:
    """Evidence, groups and models of a search; additions count from 0."""

    findings: list[Finding] = field(default_factory=list)
    """Evidence of all candidates that were fitted."""
    groups: list[tuple[str, ...]] = field(default_factory=list)
    """Names of the effects that the data cannot distinguish, of each addition."""
    hypotheses: list[dict[str, Model]] = field(default_factory=list)
    """Models with each effect of a group, of each addition."""
    widening: dict[int, np.ndarray] = field(default_factory=dict)
    """Profile likelihood of each addition over its linear fit, a factor a parameter (P,), see `profile_widening`."""
    unprofiled: dict[int, tuple[FittedModel, FittedCandidate]] = field(default_factory=dict)
    """Additions whose profile likelihood is not evaluated: the model that each was added to, and its fit."""
    rivals: dict[int, tuple[Rival, ...]] = field(default_factory=dict)
    """Candidates that explained nearly as much as each addition, and that one itself."""
    equals: dict[int, dict[str, Model]] = field(default_factory=dict)
    """Effects of other answers that the data cannot distinguish from this one, in the place of each addition."""
    time_step: FinerTimeStep | None = None
    nominal_values: tuple[FittedParameter, ...] = ()
    provisional: int | None = None
    """Index of an addition that stays only if it makes an earlier one superfluous, or explains nearly all that was
    left: what takes up an error in a formula explains a part of it."""
    form_corrected: bool = False
    """Whether a flexible correction of the last addition, and no other effect, takes away what it left."""
    with_unestablished: list[FittedModel] = field(default_factory=list)
    """The fitted models with all effects, where some are removed that are not established."""
    part_refused: bool = False
    """Whether the last search for an effect found some, and none that explains enough of the little that was left."""
    holding: tuple[HoldingConstraint, ...] = ()
    """Where dry friction holds by other constants than the model has as given."""
    held_first: int = 0
    """How many of these hold in the model that effects are added to."""
    beside_impacts: bool = False
    """Whether errors of impacts count as noise."""

    @property
    def constants(self) -> Constants:
        """Which constants of the simulator are other ones than as given."""
        return Constants(self.time_step, self.holding, self.held_first)

    @constants.setter
    def constants(self, value: Constants) -> None:
        self.time_step, self.holding, self.held_first = value

    def copy(self) -> SearchRecord:
        """Return a copy that does not change with this one."""
        return SearchRecord(**{f.name: copy(getattr(self, f.name)) for f in fields(self)})

    def accepted(self) -> list[Finding]:
        """Return the accepted effects in the order of their addition."""
        return sorted((f for f in self.findings if f.accepted), key=lambda f: f.step)

    def add(
        self, group: Sequence[tuple[FittedCandidate, Finding]], findings: Sequence[Finding], widening: np.ndarray
    ) -> None:
        """Keep the findings of an addition, the accepted one first, and its group.

        Args:
            group: The accepted candidate and those that the data cannot distinguish from it.
            findings: Evidence of all candidates.
            widening: See `SearchRecord.widening`, of the accepted one.
        """
        updated = {f.name: f for _, f in group}
        self.groups.append(tuple(updated))
        self.hypotheses.append({f.name: c.model for c, f in group})
        first = group[0][1]
        self.widening[first.step] = widening
        rest = [f for f in (updated.get(f.name, f) for f in findings) if f is not first]
        self.findings.append(first)
        self.findings += [
            replace(f, accepted=False, reason=f.reason or (ALIKE if f.name in updated else EXPLAINS_LESS))
            for f in sorted(rest, key=lambda f: -f.gain)
        ]

    def add_equals(self, step: int) -> None:
        """Add to the group of an addition what other answers have in its place, see `equals`."""
        more = {n: model for n, model in self.equals.get(step, {}).items() if n not in self.groups[step]}
        self.groups[step] = (*self.groups[step], *more)
        self.hypotheses[step] = {**self.hypotheses[step], **more}

    def refuse(self, refused: Callable[[Finding], bool], reason: str) -> None:
        """Refuse those of the accepted effects that a condition holds for."""
        self.findings = [
            replace(f, accepted=False, reason=reason) if f.accepted and refused(f) else f for f in self.findings
        ]

    def keep_groups(self, count: int) -> None:
        """Drop the groups of all additions but the first ones."""
        self.groups, self.hypotheses = self.groups[:count], self.hypotheses[:count]

    def forget(self, findings: int, groups: int) -> None:
        """Drop what was recorded after so many findings and groups."""
        self.findings = self.findings[:findings]
        self.keep_groups(groups)

    def take_back(self, findings: int, groups: int, reason: str) -> None:
        """Refuse the effect that was accepted after so many findings and groups."""
        self.keep_groups(groups)
        self.findings[findings:] = [
            replace(f, accepted=False, reason=reason) if f.accepted else f for f in self.findings[findings:]
        ]

    def update(self, old: Finding, new: Finding) -> None:
        """Put a finding in the place of another one."""
        self.findings[self.findings.index(old)] = new

    def exchange(self, old: Finding, group: Sequence[tuple[FittedCandidate, Finding]]) -> None:
        """Put the first effect of a group in the place of an accepted one, which may be the same, and its group."""
        step, best = old.step, group[0][1]
        self.groups[step] = tuple(f.name for _, f in group)
        self.hypotheses[step] = {f.name: c.model for c, f in group}
        self.add_equals(step)
        if best.name != old.name:
            self.widening[step] = np.ones(len(best.parameters))
            self.unprofiled.pop(step, None)
            self.update(old, replace(old, accepted=False, reason="another one explains more beside the others"))
            self.findings = [f for f in self.findings if f.step != step or f.name != best.name]
            self.findings.append(best)

    def remove(self, finding: Finding, reason: str) -> None:
        """Refuse an accepted effect and drop its group; of superfluous effects the groups are dropped already."""
        place = self.accepted().index(finding)
        self.update(finding, replace(finding, accepted=False, reason=reason))
        self.groups = [group for k, group in enumerate(self.groups) if k != place]
        self.hypotheses = [h for k, h in enumerate(filter(None, self.hypotheses)) if k != place]
