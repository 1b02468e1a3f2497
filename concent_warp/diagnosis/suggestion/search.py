"""The search for the motion that separates hypotheses best: the menu, and parametrised trajectories by evolution."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from concent_warp.diagnosis.experiment.joint_motions import drive_motions
from concent_warp.diagnosis.experiment.motions import ProposedMotion, RecordedRange, changes_set_up
from concent_warp.diagnosis.experiment.object_motions import body_motions
from concent_warp.diagnosis.suggestion.candidate import Candidate, joined
from concent_warp.diagnosis.suggestion.cfg import SuggestCfg
from concent_warp.diagnosis.suggestion.evaluations import Evaluations, key_of
from concent_warp.diagnosis.suggestion.evolution import DiagonalEvolution
from concent_warp.diagnosis.suggestion.forecast import Course, Forecast, courses, forecasts
from concent_warp.diagnosis.suggestion.hypotheses import Hypothesis
from concent_warp.diagnosis.suggestion.limits import MotionLimits
from concent_warp.diagnosis.suggestion.trajectories import Family, families, loaded_families
from concent_warp.simulate.select import EngineName

OUT_OF_LIMITS = 10.0
"""How far the score of a candidate that exceeds limits is below 0, more for each unit of the excess."""
FAILED = -1e9
"""Score of a candidate that cannot be simulated."""
TRIES = 30
"""Random trajectories that are tried until one is within the limits."""
FINALISTS = 4
"""Candidates of each kind whose forecast is made again with all uncertainties."""

Report = Callable[[float, str], None]


@dataclass(frozen=True)
class Rated:
    """A candidate and how good it is."""

    candidate: Candidate
    score: float
    """See `Forecast.score`; lower out of the limits."""
    excess: float
    """By how much it exceeds the limits [-]."""
    words: tuple[str, ...] = ()
    """What it exceeds."""
    key: str = ""
    """What it depends on, in short."""

    @property
    def inside(self) -> bool:
        """Whether it is within the limits."""
        return self.excess == 0 and self.score > FAILED


@dataclass(frozen=True)
class Found:
    """What a search has found."""

    best: tuple[Candidate, Forecast] | None
    """The best candidate within the limits with its forecast; None where there is none."""
    exceeded: tuple[str, ...]
    """Which limits the candidate exceeds that is nearest to them all."""


@dataclass(frozen=True)
class Search:
    """One search."""

    hypotheses: Sequence[Hypothesis]
    recorded: RecordedRange
    limits: MotionLimits
    cfg: SuggestCfg
    engine: EngineName
    needed: Callable[[Forecast], float]
    """Returns the evidence from which a hypothesis counts as excluded [nat]."""
    evaluations: Evaluations
    report: Report

    def run(self) -> Found:
        """Return the best candidate within the limits."""
        method, best = self.cfg.method, None
        rated: list[Rated] = []
        if method == "random":
            rated = [self.random()]
            best = self._compared(rated)
        for loaded in (False, True) if method in ("best", "menu") else ():
            if not loaded or self._asks_for_weights(best):
                found = self.menu(loaded=loaded)
                best = self._compared(found, best)
                rated += found
        for loaded in (False, True) if method in ("best", "optimised") else ():
            enough = method == "best" and best is not None and self.suffices(best[1])
            if not enough and (not loaded or self._asks_for_weights(best)):
                found = self.optimised(loaded=loaded)
                best = self._compared(found, best)
                rated += found
        return Found(best, min(rated, key=lambda r: r.excess).words if rated else ())

    def _asks_for_weights(self, best: tuple[Candidate, Forecast] | None) -> bool:
        """Return whether motions with known weights are tried beside the best one without."""
        return self.cfg.payloads and not (best and self.decides(best[1]))

    def _compared(
        self, rated: Sequence[Rated], best: tuple[Candidate, Forecast] | None = None
    ) -> tuple[Candidate, Forecast] | None:
        """Return the best of candidates, and of another one, when all uncertainties are taken into account."""
        for one in sorted((r for r in rated if r.inside), key=lambda r: -r.score)[:FINALISTS]:
            if best is not None and self.score(best[1]) >= self.enough:
                break
            self.report(0.3 if one.candidate.source == "menu" else 0.95, f"comparing motions: {one.candidate.name}")
            key = f"careful {one.key}"
            if key not in self.evaluations.known:
                (made,) = self.forecast([one.candidate], careful=True)
                self.evaluations.add(key, None if made is None else made.plain())
            plain = self.evaluations.known[key]
            found = None if plain is None else Forecast.of(plain)
            if found is not None and (best is None or self.score(found) > self.score(best[1])):
                best = one.candidate, found
        return best

    @property
    def enough(self) -> float:
        """Score from which on no better motion is looked for."""
        return float(np.log1p(self.cfg.enough))

    @cached_property
    def _open(self) -> list[Hypothesis]:
        """The hypotheses with all nominal values open."""
        return [h.with_nominal_values(self.cfg) for h in self.hypotheses]

    @cached_property
    def _searched(self) -> Sequence[Hypothesis]:
        """The same where these are few enough for the search."""
        few = max(h.nominal for h in self._open) <= self.cfg.max_nominal_values
        return self._open if few else self.hypotheses

    def score(self, found: Forecast) -> float:
        """Return the score of a forecast."""
        return found.score(self.needed(found), self.cfg.clear_separation)

    def decides(self, found: Forecast) -> bool:
        """Return whether a motion with some forecast is expected to leave nothing open."""
        return found.decides(self.needed(found), self.cfg.clear_separation)

    def suffices(self, found: Forecast) -> bool:
        """Return whether a motion with some forecast is expected to decide so much that none is searched."""
        return self.decides(found) or found.decides(self.cfg.sufficient * self.needed(found), 0.0)

    def menu(self, *, loaded: bool = False) -> list[Rated]:
        """Return the motions of the menu in the surroundings as they are, `loaded` or not; several of an object
        together.
        """
        recorded, found = self.recorded, list[Rated]()
        singles = [m for m in self._menu_motions() if not changes_set_up(m) and bool(m.payloads) == loaded]
        for k, batch in enumerate(_batches(singles, self.cfg.population)):
            candidates = [Candidate(m.name, m.text, (self._cut(m),), "menu") for m in batch]
            found += self.rate(candidates, [("menu", m.name, m.text) for m in batch], starts=True)
            self.report(0.3 * min((k + 1) * self.cfg.population / len(singles), 1.0), "simulating the menu")
        if recorded.longest.action or not found:
            return found
        return [*found, *self._together(found)]

    def _together(self, found: Sequence[Rated]) -> list[Rated]:
        """Return the best motions of an object, and those that add most to them, as one candidate."""
        inside = sorted((r for r in found if r.inside), key=lambda r: -r.score)
        chosen = [r.candidate for r in inside[:1]]
        for _ in range(self.cfg.trajectory.throws - 1 if chosen else 0):
            options = [joined([*chosen, r.candidate]) for r in inside if r.candidate not in chosen]
            if not options:
                break
            rated = self.rate(options, [("together", o.text) for o in options], starts=True)
            chosen = [max(rated, key=lambda r: r.score).candidate]
            chosen = [Candidate(m.name, m.text, (m,), "menu") for m in chosen[0].motions]
        whole = joined(chosen) if len(chosen) > 1 else None
        return [] if whole is None else self.rate([whole], [("together", whole.text)], starts=True)

    def _menu_motions(self) -> Iterator[ProposedMotion]:
        """Yield the motions of the menu: of the robot, and of objects by hand."""
        yield from drive_motions(self.recorded, tilted=False)
        yield from body_motions(self.recorded, self.engine, tilted=False)

    def _cut(self, motion: ProposedMotion) -> ProposedMotion:
        """Return a motion no longer than is allowed."""
        return replace(motion, duration=min(motion.duration, self.cfg.duration))

    def optimised(self, *, loaded: bool = False) -> list[Rated]:
        """Return the best trajectory of each kind, `loaded` or not."""
        kinds, found = list[Family](families(self.recorded, self.cfg, self.engine)), []
        if loaded:
            kinds = [heavy for family in kinds for heavy in loaded_families(family)]
        for k, family in enumerate(kinds):
            begin, span = 0.3 + 0.6 * k / len(kinds), 0.6 / len(kinds)
            found += self._evolved(
                family, lambda share, b=begin, s=span, f=family: self.report(b + s * share, f"searching {f.name}")
            )
        return found

    def _evolved(self, family: Family, report: Callable[[float], None]) -> list[Rated]:
        """Return the best candidates of a kind, found by evolution."""
        rng = np.random.default_rng([self.cfg.seed, family.size])
        size = self.cfg.population
        evolution, best = DiagonalEvolution(family.size, size, rng), list[Rated]()
        generations = max(self.cfg.evaluations // size, 1)
        highest, since = -np.inf, 0
        for k in range(generations):
            samples = evolution.ask()
            rated = self.rate(
                [family.candidate(x, "optimised") for x in samples],
                [(family.name, x) for x in samples],
                starts=family.starts,
            )
            evolution.tell(samples, np.array([r.score for r in rated]))
            best = sorted([*best, *rated], key=lambda r: -r.score)[:FINALISTS]
            report((k + 1) / generations)
            now = max((r.score for r in best if r.inside), default=-np.inf)
            highest, since = (now, 0) if now > highest + self.cfg.min_gain else (highest, since + 1)
            if now >= self.enough or (np.isfinite(highest) and since >= self.cfg.patience):
                break
        return best

    def random(self) -> Rated:
        """Return the first of the random trajectories that is within the limits, or the one nearest to them."""
        kinds = families(self.recorded, self.cfg, self.engine)[:1]
        rng, tried = np.random.default_rng([self.cfg.seed, 1]), list[Rated]()
        for k, family in enumerate(kinds * TRIES):
            x = rng.normal(size=family.size)
            tried += self.rate([family.candidate(x, "random")], [(family.name, "random", x)], starts=family.starts)
            self.report(0.9 * (k + 1) / TRIES, "sampling a motion")
            if tried[-1].inside:
                break
        return min(tried, key=lambda r: (r.excess, -r.score)) if tried else _nothing()

    def rate(self, candidates: Sequence[Candidate], keys: Sequence[tuple[object, ...]], *, starts: bool) -> list[Rated]:
        """Return candidates with their scores; those that are known are not simulated again.

        Args:
            candidates: What to rate.
            keys: What each depends on, besides the settings of the search.
            starts: Whether initial states are estimated too.
        """
        named = [key_of(*key) for key in keys]
        fresh = [k for k, key in enumerate(named) if key not in self.evaluations.known]
        for k, found in zip(fresh, self._rated([candidates[k] for k in fresh], starts=starts), strict=True):
            self.evaluations.add(named[k], [found.score, found.excess, list(found.words)])
        known = [self.evaluations.known[key] for key in named]
        return [
            Rated(candidate, -np.inf if score is None else float(score), float(excess), tuple(words), key)
            for candidate, key, (score, excess, words) in zip(candidates, named, known, strict=True)
        ]

    def _rated(self, candidates: Sequence[Candidate], *, starts: bool) -> list[Rated]:
        """Return the ratings of candidates, simulated in one batch a hypothesis.

        Those out of the limits are ranked by how far, and not forecast.
        """
        if not candidates:
            return []
        owner = [k for k, c in enumerate(candidates) for _ in c.motions]
        moves = courses(self.hypotheses, self.recorded, [m for c in candidates for m in c.motions], self.engine)
        parts: list[list[tuple[ProposedMotion, Course]] | None] = [[] for _ in candidates]
        for k, motion, course in zip(owner, (m for c in candidates for m in c.motions), moves, strict=True):
            row = parts[k]
            if course is None or row is None:
                parts[k] = None
            else:
                row.append((motion, course))
        found, within = list[Rated](), list[list[tuple[ProposedMotion, Course]]]()
        for candidate, part in zip(candidates, parts, strict=True):
            over = [self.limits.excess(*each) for each in part or ()]
            size, words = sum(e.size for e in over), tuple(dict.fromkeys(w for e in over for w in e.words))
            within += [part] if part and size == 0 else []
            found.append(Rated(candidate, -OUT_OF_LIMITS * (1 + size), size if part else np.inf, words))
        made = iter(
            forecasts(
                self._searched,
                self.recorded,
                within,
                self.engine,
                window=self.cfg.window,
                step=self.cfg.step,
                starts=starts,
            )
        )
        for k, one in enumerate(found):
            if one.excess == 0:
                forecast = next(made)
                found[k] = replace(one, score=-np.inf if forecast is None else self.score(forecast))
        failed = lambda r: not (np.isfinite(r.score) and np.isfinite(r.excess))  # noqa: E731
        return [replace(r, score=FAILED, excess=min(r.excess, -FAILED)) if failed(r) else r for r in found]

    def forecast(self, candidates: Sequence[Candidate], *, careful: bool) -> list[Forecast | None]:
        """Return the forecasts of candidates with all uncertainties."""
        found: list[Forecast | None] = []
        for candidate in candidates:
            moves = courses(self.hypotheses, self.recorded, candidate.motions, self.engine)
            parts = [(m, c) for m, c in zip(candidate.motions, moves, strict=True) if c is not None]
            found += (
                forecasts(
                    self._open,
                    self.recorded,
                    [parts],
                    self.engine,
                    window=self.cfg.window,
                    step=self.cfg.step,
                    careful=careful,
                    seed=self.cfg.seed,
                )
                if len(parts) == len(candidate.motions)
                else [None]
            )
        return found


def _batches(items: Sequence[ProposedMotion], size: int) -> Iterator[tuple[ProposedMotion, ...]]:
    """Yield items by batches."""
    iterator = iter(items)
    while batch := tuple(itertools.islice(iterator, size)):
        yield batch


def _nothing() -> Rated:
    """Return the rating of no motion at all."""
    return Rated(Candidate("none", "", (), "random"), -np.inf, np.inf)
