"""Fits of the promising candidates of one addition, with the rivals of the best refitted until none lags by chance.

Initial states have local minima, more so with contacts. A candidate whose fit ended in one gains too little, so those
that may equal the best are refitted from its initial states, and none gets more refits than the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel, ScreenedCandidate
from concent_warp.diagnosis.candidates.fit_candidate import (
    fit_candidate,
    multiple_shooting_candidate,
    polish_candidate,
    restart_candidate,
    restart_like,
    search_candidate_value,
)
from concent_warp.diagnosis.candidates.growing_windows import baseline_of_first_parts, continue_fit, fit_first_parts
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.tasks import TaskRunner
from concent_warp.diagnosis.time_budget import in_words
from concent_warp.effects.effect import Effect
from concent_warp.fit.effects.observation import Window
from concent_warp.simulate.time_limit import TimeUpError


class CandidateFits:
    """The fits of candidates to one baseline."""

    def __init__(self, base: FittedModel, cfg: DiagnoseCfg, runner: TaskRunner) -> None:
        """Prepare to fit candidates to a baseline."""
        self.base, self.cfg, self.search, self.runner = base, cfg, cfg.search, runner
        self.fits: list[FittedCandidate] = []
        self.fitted: list[ScreenedCandidate] = []
        """The same as they were screened."""
        self.left: list[ScreenedCandidate] = []
        """Candidates that there was no time to fit."""
        self.unrefined: list[int] = []
        """Indices of the fits that there was no time to refine."""
        self.started_from: set[tuple[int, int]] = set()
        """Indices of fits that were restarted, each with that of the best one from whose initial states."""
        self.restarted: set[tuple[int, float, float]] = set()
        """Fits that have been restarted from the best, by index and both costs: again it would be the same."""

    def fit(
        self,
        screened: Sequence[ScreenedCandidate],
        needed_gain: float,
        short_windows: Callable[[], Sequence[Window]],
        least_promise: float = 0.0,
    ) -> list[FittedCandidate]:
        """Return fits of the promising candidates, the most promising first, after those of earlier calls.

        Candidates of a later call must promise enough beside the best of the earlier ones, too.

        Args:
            screened: All candidates that were not among those of an earlier call.
            needed_gain: Gain that a candidate needs to be accepted.
            short_windows: Returns the windows of a multiple-shooting fit.
            least_promise: Expected gain below which none is fitted, whatever is needed.
        """
        if self.fits:
            least_promise = max(least_promise, self.search.explained_min_gain * self._best().share(self.base))
        promising = [s for s in screened if s.expected_gain > max(self._least_share(s) * needed_gain, least_promise)]
        promising.sort(key=lambda s: -s.expected_gain)
        more = self._fit_in_batches(_a_few_of_each(promising, self.search.fits_of_each)[: self.cfg.max_fits])
        self.fitted += more
        if not more:
            return self.fits
        pairs = zip(self.fits, self.fitted, strict=True)
        expected = np.array([max(c.share(self.base), s.expected_gain) for c, s in pairs])
        if expected.max() < self.cfg.min_gain:  # none explains enough to be accepted, however well it is fitted
            return self.fits
        if self._best().share(self.base) < self.search.stuck_share * least_promise:
            return self.fits  # what was expected of them is not there
        added = self._continue_from_first_parts(screened, short_windows)
        expected = np.maximum(np.pad(expected, (0, added)), [c.share(self.base) for c in self.fits])
        self._search_values()
        best = self._best()
        self._restart_lagging(best, expected)
        self._polish_near(best, expected)
        expected = np.maximum(expected, [c.share(self.base) for c in self.fits])
        self.refit_rivals(expected)
        self._fit_confusions(screened)
        if self._restart_left_behind():
            self.refit_rivals(np.array([c.share(self.base) for c in self.fits]))
        self._restart_like_best()
        if self._best().ratio > self.cfg.adequate_ratio and self._left() > self.cfg.unknown_force.min_share:
            self._initialise_by_multiple_shooting(short_windows)
        return self.fits

    def _least_share(self, s: ScreenedCandidate) -> float:
        """Return the expected gain over the needed one, above which a candidate is fitted [-]."""
        return self.search.min_scanned_gain if s.scanned_gain > 0 else self.search.min_expected_gain

    def unsettled(self, name: Callable[[Effect], str]) -> list[tuple[str, bool]]:
        """Return sentences on what there was no time for, and whether it may change which effect is the best.

        Args:
            name: Returns the name of an effect.
        """
        found = []
        if self.left:
            names = [f"{name(s.effect)} (expected to remove {100 * s.expected_gain:.0f} %)" for s in self.left]
            found.append((f"Not fitted: {in_words(names)}.", True))
        if not self.unrefined:
            return found
        best = self.fits.index(self._best())
        # From the initial states of the best one a rival explains what it can beside it: others would change both.
        rivals = [k for k in self.unrefined if k != best and (k, best) not in self.started_from]
        others = [k for k in self.unrefined if k not in rivals]
        for chosen, lead, decides in (
            (rivals, "Fits not refined, which may explain as much as the best", True),
            (others, "Fits not refined" if len(others) > 1 else "Fit not refined", False),
        ):
            if chosen:
                found.append((f"{lead}: {in_words([name(self.fits[k].effect) for k in chosen])}.", decides))
        return found

    def refit_rivals(self, expected: np.ndarray) -> None:
        """Refit the best candidate and those that may equal it, for as long as that lowers the cost of one.

        Rivals start from the initial states of the best too, where contacts make the cost rough and local minima would
        decide between them; over many windows these average out, and one round is enough.

        Args:
            expected: Gain that each candidate may have, shape (candidates,).
        """
        base, search = self.base, self.search
        for _ in range(search.max_rounds if len(base.windows) <= base.cfg.least_squares.max_polished_windows else 1):
            before, best = list(self.fits), self._best()
            k_best, least = self.fits.index(best), search.close_min_gain * best.share(base)
            close = [k for k, c in enumerate(self.fits) if c is not best and expected[k] > least]
            pairs = {k: (k, self.fits[k].fit.cost, best.fit.cost) for k in close}
            anew = [k for k in close if pairs[k] not in self.restarted]
            self.restarted |= {pairs[k] for k in anew}
            self._restart(anew, best)
            near = [k for k in close if self.fits[k].share(base) > least]
            if any(self.fits[k].errors.sum() > (1 + search.equal_error) * best.errors.sum() for k in near):
                self._refit([*near, k_best], polish_candidate, "refining initial states", search)
            elif best.ratio > search.noise_level_ratio:  # those near are its equals already
                self._refit([k_best], polish_candidate, "refining initial states", search)
            if all(
                c.fit.cost > (1 - search.min_cost_fall) * old.fit.cost for c, old in zip(self.fits, before, strict=True)
            ):
                break
            expected = np.array([c.share(base) for c in self.fits])

    def _best(self) -> FittedCandidate:
        """Return the fit that removes most of the baseline's error."""
        return max(self.fits, key=lambda c: c.share(self.base))

    def _left(self) -> float:
        """Return the share of the baseline's squared residual beyond the noise that the best fit leaves [-]."""
        return (self._best().ratio ** 2 - 1) / max(self.base.ratio**2 - 1, 1e-9)

    def _refit(
        self, chosen: Sequence[int], task: Callable[..., FittedCandidate], text: str, *settings: Any
    ) -> list[int]:
        """Replace some fits by what a task makes of each; returns those that there was time for."""
        tasks, done = [(self.base, self.fits[k], *settings) for k in chosen], []
        for k, c in zip(chosen, self.runner.run_in_time(task, tasks, text), strict=True):
            if c is not None:
                self.fits[k] = c
                done.append(k)
            elif k not in self.unrefined:
                self.unrefined.append(k)
        return done

    def _restart(self, chosen: Sequence[int], best: FittedCandidate, *, quick: bool = False) -> None:
        """Restart some fits from the initial states of the best, see `restart_candidate`."""
        place = self.fits.index(best)
        settings = (best.fit, self.search, True) if quick else (best.fit, self.search)
        done = self._refit(chosen, restart_candidate, "fitting rivals again", *settings)
        self.started_from |= {(k, place) for k in done}

    def _fit_in_batches(self, promising: Sequence[ScreenedCandidate]) -> list[ScreenedCandidate]:
        """Fit candidates, a few at a time; once one explains most, only those that promise enough beside it.

        Returns those that were fitted.
        """
        base, search, left = self.base, self.search, list(promising)
        fitted: list[ScreenedCandidate] = []
        while left:
            batch, left = left[: search.batch_size], left[search.batch_size :]
            tasks = [(base, s) for s in batch]
            for s, c in zip(batch, self.runner.run_in_time(fit_candidate, tasks, "fitting"), strict=True):
                if c is None:
                    self.left.append(s)
                else:
                    fitted.append(s)
                    self.fits.append(c)
            if not self.fits:
                continue
            least = min(c.ratio for c in self.fits)
            if least < search.explained_ratio or self._left() < search.decided_share:
                best = self._promised_by_best(fitted)
                at_noise = least < search.noise_level_ratio
                needed = search.noise_level_min_gain if at_noise else search.explained_min_gain
                left = [s for s in left if s.expected_gain > needed * best]
                self.left = [s for s in self.left if s.expected_gain > needed * best]
        return fitted

    def _promised_by_best(self, fitted: Sequence[ScreenedCandidate]) -> float:
        """Return the gain that the promises of others are compared with [-]: that of the best fit.

        Where this is far more than it promised, as where the initial states of the baseline are those of a local
        minimum, promises are all too small, and are compared with that of the best.

        Args:
            fitted: The candidates of the last fits, as they were screened; none where there was no time for any.
        """
        last = zip(self.fits[len(self.fits) - len(fitted) :], fitted, strict=True)
        share, promise = max(((c.share(self.base), s.expected_gain) for c, s in last), default=(0.0, 0.0))
        best = self._best().share(self.base)
        return promise if share == best and promise < self.search.stuck_share * share else best

    def _search_values(self) -> None:
        """Search the values of candidates near the best whose fits ended at the scanned value where they started."""
        base, search = self.base, self.search
        if all(w.smooth for w in base.windows):
            return
        least = search.polish_min_gain * self._best().share(base)
        for k, (c, s) in enumerate(zip(self.fits, self.fitted, strict=True)):
            near = c.share(base) > least and c.ratio > search.noise_level_ratio
            if near and s.scanned_gain > 0 and np.array_equal(c.fit.values, s.start):
                self._refit([k], search_candidate_value, "searching values", s.start, search)

    def _restart_lagging(self, best: FittedCandidate, expected: np.ndarray) -> None:
        """Restart candidates that lag behind one that explains the data from its initial states.

        A fit in a local minimum gains too little; the gains after the restart are written into `expected`.
        """
        if best.ratio >= self.search.explained_ratio:
            return
        low, high = (
            share * best.share(self.base) for share in (self.search.restart_min_gain, self.search.polish_min_gain)
        )
        lagging = [k for k in range(len(self.fits)) if low < expected[k] <= high]
        self._restart(lagging, best, quick=True)
        for k in lagging:
            expected[k] = max(expected[k], self.fits[k].share(self.base))

    def _fit_confusions(self, screened: Sequence[ScreenedCandidate]) -> None:
        """Fit what a best one that leaves only noise is confused with, however little it promised.

        Promises are linear in initial states that contacts make rough: an effect that moves the same as the best, and
        of which a screening saw nothing, must not be missing from the group.
        """
        best, search = self._best(), self.search
        little = best.ratio < search.explained_ratio or self._explains_nearly_all(best)
        if not little or best.share(self.base) < self.cfg.min_gain:
            return
        known = {id(s) for s in (*self.fitted, *self.left)}
        rivals = [s for s in screened if id(s) not in known and _are_confused(s.effect, best.effect)]
        rivals = _a_few_of_each([s for s in rivals if not s.effect.is_part], search.fits_of_each)
        tasks = [(self.base, s) for s in rivals]
        for s, c in zip(rivals, self.runner.run_in_time(fit_candidate, tasks, "fitting confusions"), strict=True):
            if c is None:
                self.left.append(s)
            else:
                self.fitted.append(s)
                self.fits.append(c)

    def _explains_nearly_all(self, one: FittedCandidate) -> bool:
        """Return whether a candidate leaves no more than a further effect may leave of a small remainder."""
        return one.share(self.base) >= 1 - self.cfg.max_remainder

    def _restart_like_best(self) -> None:
        """Refit what a best one is confused with, and what explains far less, from the best one's value.

        From no change on, steps may lead nowhere where errors grow as fast as they do in an unstable machine.
        """
        best = self._best()
        if not self._explains_nearly_all(best) or len(units := self._added_units(best.effect)) != 1:
            return
        least = self.search.close_min_gain * best.share(self.base)
        behind = [
            k
            for k, c in enumerate(self.fits)
            if c.share(self.base) <= least
            and _are_confused(c.effect, best.effect)
            and self._added_units(c.effect) == units
        ]
        self._refit(behind, restart_like, "fitting confusions", best)

    def _added_units(self, effect: Effect) -> list[str]:
        """Return the units of an effect's parameters."""
        prediction = self.base.prediction(effect)
        return [p.unit for p in prediction.parameters[prediction.owned :]]

    def _restart_left_behind(self) -> bool:
        """Restart candidates far behind a best one that leaves only noise from its initial states.

        Those are its confusions, and others that came some way before it was refined. Returns whether one is near then.
        """
        best, search = self._best(), self.search
        if best.ratio >= search.explained_ratio:
            return False
        gain = best.share(self.base)
        behind = [
            k
            for k, c in enumerate(self.fits)
            if c is not best
            and c.share(self.base) <= search.close_min_gain * gain
            and (c.share(self.base) > search.explained_min_gain * gain or _are_confused(c.effect, best.effect))
        ]
        self._restart(behind, best, quick=True)
        return any(self.fits[k].share(self.base) > search.polish_min_gain * gain for k in behind)

    def _polish_near(self, best: FittedCandidate, expected: np.ndarray) -> None:
        """Refit the initial states of candidates near the best that have not reached the noise.

        Of those that explain what they promised only the most promising: the others are restarted from the best one's
        initial states first. Those that explain far less are stuck in a local minimum of their own. Beside a best one
        that has reached the noise, those close to it are left to `refit_rivals`, which restarts them first, too.
        """
        search, gain = self.search, best.share(self.base)
        restarted = best.ratio < search.noise_level_ratio
        chosen = [
            k
            for k, c in enumerate(self.fits)
            if expected[k] > search.polish_min_gain * gain
            and c.ratio > search.noise_level_ratio
            and not (restarted and c.share(self.base) > search.close_min_gain * gain)
        ]
        chosen = sorted(chosen, key=lambda k: -expected[k])
        stuck = [k for k in chosen if self.fits[k].share(self.base) < search.stuck_share * expected[k]]
        kept = [k for k in chosen if k not in stuck][: search.polished_first]
        self._refit([*kept, *stuck[: search.polished_stuck]], polish_candidate, "refining initial states", search)

    def _continue_from_first_parts(
        self, screened: Sequence[ScreenedCandidate], short_windows: Callable[[], Sequence[Window]]
    ) -> int:
        """Fit candidates over the first part of each window, and continue the best of these fits as windows grow.

        That is for long windows with contacts that cannot be cut into short ones, where no fit explains the data.
        Returns how many candidates it adds to those that were fitted already.
        """
        base, search, length = self.base, self.search, self.search.shooting_window
        if self._best().ratio < search.explained_ratio or not self._cannot_be_cut(short_windows):
            return 0
        tasks = [(base, length)]
        near = next(iter(self.runner.run_in_time(baseline_of_first_parts, tasks, "fitting the first parts of windows")))
        if near is None or near.ratio**2 < 1 + self.cfg.min_gain:
            return 0
        tasks = [(near, s.effect, search, self.cfg.min_gain) for s in screened]
        found = self.runner.run_in_time(fit_first_parts, tasks, "fitting the first parts of windows")
        ranked = sorted(
            ((c.share(near), s, c) for s, c in zip(screened, found, strict=True) if c is not None),
            key=lambda row: -row[0],
        )
        least = max(self.cfg.min_gain, search.shooting_min_gain * ranked[0][0]) if ranked else 0.0
        chosen = [(s, c) for share, s, c in ranked if share > least][: search.shooting_fits]
        tasks = [(base, c, search, self.cfg.min_gain, self._best()) for _, c in chosen]
        added, places = 0, {id(s): k for k, s in enumerate(self.fitted)}  # fits from other processes have copies
        for (s, _), c in zip(chosen, self.runner.run_in_time(continue_fit, tasks, "growing windows"), strict=True):
            if c is None:
                continue
            if (k := places.get(id(s))) is not None:
                self.fits[k] = min(self.fits[k], c, key=lambda one: one.fit.cost)
            else:
                self.fits.append(c)
                self.fitted.append(s)
                added += 1
        return added

    def _cannot_be_cut(self, short_windows: Callable[[], Sequence[Window]]) -> bool:
        """Return whether there are long windows with contacts, and no short ones since states were not measured."""
        shortest = 2 * self.search.shooting_window
        if not any(w.end - w.start >= shortest and not w.smooth for w in self.base.windows):
            return False
        try:
            return any(w.end - w.start >= shortest for w in short_windows())
        except TimeUpError:
            return False

    def _initialise_by_multiple_shooting(self, short_windows: Callable[[], Sequence[Window]]) -> None:
        """Refit the candidates that explain most from the values of a fit over shorter windows."""
        base, search = self.base, self.search
        if max(w.end - w.start for w in base.windows) < 2 * search.shooting_window:
            return
        try:
            windows = short_windows()
        except TimeUpError:
            return
        if any(w.end - w.start >= 2 * search.shooting_window for w in windows):  # these cannot be cut
            return
        least = search.shooting_min_gain * max(c.share(base) for c in self.fits)
        near = sorted(
            (k for k, c in enumerate(self.fits) if c.share(base) > least), key=lambda k: self.fits[k].fit.cost
        )
        self._refit(near[: search.shooting_fits], multiple_shooting_candidate, "multiple shooting", windows)


def _are_confused(one: Effect, other: Effect) -> bool:
    """Return whether one of two effects says that it is confused with the other."""
    return other.name in one.confusions or one.name in other.confusions


def _a_few_of_each(promising: Sequence[ScreenedCandidate], most: int) -> list[ScreenedCandidate]:
    """Return candidates without those that are further parts of what at most so many before them are of, as one body.

    Args:
        promising: Candidates, the most promising first.
        most: Most candidates of one effect on the same elements.
    """
    count: dict[tuple[str, ...], int] = {}
    kept = []
    for s in promising:
        key = (s.effect.name, *s.effect.elements)
        count[key] = count.get(key, 0) + 1
        if count[key] <= most:
            kept.append(s)
    return kept
