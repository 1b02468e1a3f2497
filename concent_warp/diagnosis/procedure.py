"""The procedure of a diagnosis, from a recording and a model to a verdict.

Cut the recording into windows, fit the model's own parameters and the initial states, screen all candidate effects by
their sensitivities and a few scanned values, fit the most promising ones, and judge them on held-out blocks of time
against what chance makes of the whole search. Add the best, and begin again with the model that has it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar, cast

import numpy as np

from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.check_data import check_data
from concent_warp.diagnosis.experiment.suggest import suggest
from concent_warp.diagnosis.failures import where
from concent_warp.diagnosis.result import Detectable, Diagnosis, Finding, Verdict
from concent_warp.diagnosis.search.candidates import candidates, label
from concent_warp.diagnosis.search.evidence import SAME, alike, detectable_size, fitted_parameters, removed
from concent_warp.diagnosis.search.gradient_start import GradientStarts
from concent_warp.diagnosis.search.profile_likelihood import ProfilePoint, settled
from concent_warp.diagnosis.search.steps import (
    Candidate,
    FittedModel,
    Screened,
    chance,
    extended,
    fit_candidate,
    node,
    piecewise_candidate,
    polish_candidate,
    restarted_candidate,
    screen,
    strengthened,
    without,
)
from concent_warp.diagnosis.search.unknown_force import unknown_force
from concent_warp.estimation.noise import UNDERESTIMATE
from concent_warp.fit.effects.cross_validation import bootstrap_interval, cut_blocks, sign_flip_p
from concent_warp.fit.effects.fit import check_finite
from concent_warp.fit.effects.least_squares import MANY
from concent_warp.fit.effects.observe import channel_noises, observe
from concent_warp.fit.effects.prediction import Prediction
from concent_warp.model import Model
from concent_warp.recording.recording import Recording
from concent_warp.simulate.select import EngineName
from concent_warp.simulate.threads import at_most

T = TypeVar("T")


Progress = Callable[[float, str], None]
"""Called with the share done, 0..1, and what is being done."""


def silent(share: float, text: str) -> None:
    """Say nothing, see `Progress`."""
    del share, text


class Procedure:
    """One diagnosis on its way."""

    def __init__(
        self, model: Model, recording: Recording, cfg: DiagnoseCfg, progress: Progress, engine: EngineName = "mujoco"
    ) -> None:
        self.model, self.recording, self.cfg, self.progress = model, recording, cfg, progress
        self.engine: EngineName = engine
        self.channels = {c for d in recording.demonstrations for c in d.measured}
        self.findings: list[Finding] = []
        self.groups: list[tuple[str, ...]] = []
        self.hypotheses: list[dict[str, Model]] = []
        self.gradient = GradientStarts(model, recording) if cfg.gradient else None
        self.noise: dict[str, float] = {}
        self._done = 0.0
        self._began = time.monotonic()

    def run(self) -> Diagnosis:
        """Go through the procedure."""
        with at_most(self.cfg.jobs if self.cfg.jobs > 0 else None):
            return self._run()

    def _run(self) -> Diagnosis:
        issues = check_data(self.recording)
        self.progress(0.0, "cutting windows")
        base = self.baseline()
        nodes, detectable = [base], ()
        for step in range(self.cfg.additions):
            if step and nodes[-1].ratio ** 2 < 1 + self.cfg.least_gain:
                break  # what is left beyond the noise is less than an effect must take away
            self._done = 0.1 + 0.85 * step / self.cfg.additions
            best, smallest = self.addition(nodes[-1], step)
            detectable = detectable or smallest
            if best is None:
                break
            nodes.append(extended(nodes[-1], best))
        nodes = self.pruned(nodes)
        self.progress(1.0, "done")
        return self.conclude(nodes, detectable, issues)

    def baseline(self) -> FittedModel:
        """Return the model as it is, with its own parameters and the initial states fitted.

        Noise that is estimated and not stated is taken for larger where even the blocks that the model explains best
        show more: readings that were filtered tell too little of it.
        """
        noise = channel_noises(self.model, self.recording)
        recorded = [d.measured for d in self.recording.demonstrations]
        told = {c for c in noise if all(m[c].noise_std for m in recorded if c in m)}
        if told >= set(noise):
            return self.fitted_baseline(noise)
        seen = _quiet_ratios(self.fitted_baseline(noise, rough=True))
        larger = {c: r for c, r in seen.items() if c not in told and r > UNDERESTIMATE}
        return self.fitted_baseline({c: std * larger.get(c, 1.0) for c, std in noise.items()})

    def fitted_baseline(self, noise: Mapping[str, float], *, rough: bool = False) -> FittedModel:
        """Return the model as it is, fitted to readings of some noise."""
        cfg = self.cfg
        self.noise = dict(noise)
        windows = observe(self.model, self.recording, length=cfg.window, noise=noise, engine=self.engine, seed=cfg.seed)
        self.progress(0.03, "fitting the model as it is")
        check_finite(Prediction(self.model, (), windows, engine=self.engine), self.model.scene.source)
        return node(self.model, windows, cut_blocks(windows), self.engine, rough=rough)

    def addition(self, base: FittedModel, step: int) -> tuple[Candidate | None, tuple[Detectable, ...]]:
        """Look for one effect that the node's model lacks; return it, and what could have been seen."""
        chosen = candidates(base.model, self.channels, self.cfg.effects)
        span = 0.85 / self.cfg.additions
        screened = self.parallel(screen, [(base, e) for e in chosen], "screening", 0.5 * span)
        screened = self.gradient.led(base, screened, self.parallel) if self.gradient else screened
        null = chance(base, screened, self.cfg.draws, self.cfg.seed)
        critical = float(np.quantile(null, 1 - self.cfg.level))
        needed = max(critical, self.cfg.least_gain)
        smallest = tuple(found for s in screened if (found := detectable_size(base, s, needed)) is not None)
        fitted = self.fitted(base, screened, critical)
        findings = [self.finding(base, c, null, step, chosen) for c in fitted]
        rivals = [c for c, f in zip(fitted, findings, strict=True) if f.accepted]
        if rivals and max(c.share(base) for c in rivals) < DOUBTFUL:
            base = strengthened(base, sorted(rivals, key=lambda c: -c.share(base))[:STRONGEST])
            findings = [self.finding(base, c, null, step, chosen) for c in fitted]
        good = [(c, f) for c, f in zip(fitted, findings, strict=True) if f.accepted]
        if not good:
            self.findings += sorted(findings, key=lambda f: -f.gain)
            return None, smallest
        group = self.told_apart(base, good, lambda c: self.finding(base, c, null, step, chosen))
        replaced = {f.name: f for _, f in group}
        findings = [replaced.get(f.name, f) for f in findings]
        self.groups.append(tuple(f.name for _, f in group))
        self.hypotheses.append({f.name: c.model for c, f in group})
        first = group[0][1]
        rest = sorted((f for f in findings if f is not first), key=lambda f: -f.gain)
        self.findings.append(first)
        self.findings += [replace(f, accepted=False, reason=f.reason or "another one explains more") for f in rest]
        return group[0][0], smallest

    def told_apart(
        self, base: FittedModel, good: Sequence[tuple[Candidate, Finding]], judge: Callable[[Candidate], Finding]
    ) -> list[tuple[Candidate, Finding]]:
        """Return the accepted candidates that the data cannot tell apart, the likeliest first, its values polished.

        Where some are nearly so, values are looked around, which betters them and tells how rough the costs are; over
        many windows that shows in how their errors differ.
        """

        def anew(c: Candidate) -> tuple[Candidate, Finding]:
            # What was accepted stays so: its gain is the evidence, even if a rough cost tells little of the value.
            return c, replace(judge(c), accepted=True, reason="")

        near = alike(base, good, slack=WIDER)
        if len(near) > len(alike(base, good)) and len(base.windows) <= MANY:
            near = [anew(settled(base, c, self.settling)) for c, _ in near[:STRONGEST]] + near[STRONGEST:]
        group = alike(base, near)
        polished = polish_candidate(base, group[0][0], thorough=True)
        group[0] = anew(settled(base, polished, self.settling))
        return group

    def pruned(self, nodes: list[FittedModel]) -> list[FittedModel]:
        """Return the nodes, with one more for each effect that those added after it have made superfluous."""
        steps = list(range(len(nodes) - 1))
        while len(steps) > 1:
            last = nodes[-1]
            owned = len(last.model.effects) - len(steps)
            # The last one has just shown its worth beside all others.
            self.progress(self._done, "leaving out one at a time")
            tried = list(_run_all(without, [(last, owned + k) for k in range(len(steps) - 1)], self.cfg.jobs))
            shares = [1 - last.errors.sum() / max(n.errors.sum(), 1e-12) for n in tried]
            least = int(np.argmin(shares))
            if shares[least] >= self.cfg.least_gain:
                break
            step = steps.pop(least)
            nodes = [*nodes, tried[least]]
            self.groups[step], self.hypotheses[step] = (), {}
            self.findings = [
                replace(f, accepted=False, reason="of no use beside those added later")
                if f.accepted and f.step == step
                else f
                for f in self.findings
            ]
        self.groups = [group for group in self.groups if group]
        return nodes

    def fitted(self, base: FittedModel, screened: Sequence[Screened], critical: float) -> list[Candidate]:
        """Fit the promising candidates, the most promising first; once one leaves only noise, no distant others."""
        promising = sorted((s for s in screened if s.promise > 0.5 * critical), key=lambda s: -s.promise)
        left, found = promising[: self.cfg.survivors], []
        while left:
            found += self.parallel(fit_candidate, [(base, s) for s in left[:FIRST]], "fitting", 0.15 / FIRST)
            left = left[FIRST:]
            if (least := min(c.ratio for c in found)) < EXPLAINED:
                best = max(c.share(base) for c in found)
                left = [s for s in left if s.promise > (HALF if least < SETTLED else DISTANT) * best]
        if not found:
            return found
        hoped = np.array([max(c.share(base), s.promise) for c, s in zip(found, promising, strict=False)])
        best = _leader(base, found)
        if best.ratio < EXPLAINED:
            # A fit that is stuck gains too little: where another is done, it can lead rivals far behind out of that.
            most = best.share(base)
            far = [k for k in range(len(found)) if HALF * most < hoped[k] <= NEAR * most]
            tasks = [(base, found[k], best.fit, True) for k in far]
            for k, c in zip(far, self.parallel(restarted_candidate, tasks, "fitting rivals anew", 0.0), strict=True):
                found[k] = c
                hoped[k] = max(hoped[k], c.share(base))
        most = best.share(base)
        # Those beside a fit that leaves nothing are led on from its initial states first, see `level`.
        later = [best.ratio < SETTLED and c.share(base) > CLOSE * most for c in found]
        rough = [k for k, c in enumerate(found) if hoped[k] > NEAR * most and c.ratio > SETTLED and not later[k]]
        polished = self.parallel(polish_candidate, [(base, found[k]) for k in rough], "polishing", 0.0)
        for k, c in zip(rough, polished, strict=True):
            found[k] = c
        hoped = np.maximum(hoped, [c.share(base) for c in found])
        self.level(base, found, hoped)
        return self.pieced(base, found) if _leader(base, found).ratio > self.cfg.adequate else found

    def level(self, base: FittedModel, found: list[Candidate], hoped: np.ndarray) -> None:
        """Take up the best fit, and those of candidates that may be its equals, as long as that betters one; in place.

        Where contacts make the cost rough, luck with the initial states would decide between them: so each is tried
        from where the best one has them too, and none gets more rounds than the others. `hoped` is the gain that
        there may be in each.
        """
        for _ in range(ROUNDS if len(base.windows) <= MANY else 1):  # over many windows luck evens out
            before, best = list(found), _leader(base, found)
            close = [k for k, c in enumerate(found) if c is not best and hoped[k] > CLOSE * best.share(base)]
            tasks = [(base, found[k], best.fit) for k in close]
            again = self.parallel(restarted_candidate, tasks, "fitting rivals anew", 0.0)
            for k, c in zip(close, again, strict=True):
                found[k] = c
            mine = found.index(best)
            near = [k for k in close if found[k].share(base) > CLOSE * best.share(base)]
            if any(found[k].errors.sum() > (1 + SAME) * best.errors.sum() for k in near):
                near.append(mine)
                polished = self.parallel(polish_candidate, [(base, found[k]) for k in near], "polishing", 0.0)
                for k, c in zip(near, polished, strict=True):
                    found[k] = c
            elif best.ratio > SETTLED:  # those near are its equals already
                found[mine] = polish_candidate(base, best)
            if all(c.fit.cost > (1 - FINE) * old.fit.cost for c, old in zip(found, before, strict=True)):
                break
            hoped = np.array([c.share(base) for c in found])

    def pieced(self, base: FittedModel, found: list[Candidate]) -> list[Candidate]:
        """Return fitted candidates, those that explain most fitted anew by way of short windows, where there are."""
        if max(w.end - w.start for w in base.windows) < 2 * PIECE:
            return found
        cfg = self.cfg
        pieces = observe(base.model, self.recording, length=PIECE, noise=self.noise, engine=self.engine, seed=cfg.seed)
        best = max(c.share(base) for c in found)
        near = sorted((k for k, c in enumerate(found) if c.share(base) > HALF * best), key=lambda k: found[k].fit.cost)
        again = self.parallel(
            piecewise_candidate, [(base, found[k], pieces) for k in near[:FIRST]], "fitting piece by piece", 0.0
        )
        for k, c in zip(near, again, strict=False):
            found[k] = c
        return found

    def finding(self, base: FittedModel, c: Candidate, null: np.ndarray, step: int, among: Sequence[Any]) -> Finding:
        """Return a fitted candidate with its evidence."""
        rng = np.random.default_rng(self.cfg.seed)
        share, gain = c.share(base), c.gain(base)
        low, high = bootstrap_interval(gain, base.errors, base.blocks.demonstration, rng)
        p = float((1 + np.sum(null >= share)) / (len(null) + 1))
        parameters = fitted_parameters(base, c)
        reason = ""
        if p > self.cfg.level:
            reason = "no better than chance"
        elif share < self.cfg.least_gain:
            reason = f"takes away less than {100 * self.cfg.least_gain:.0f} % of the error"
        elif low <= 0:
            reason = "the interval of its gain includes none"
        elif np.mean([gain[base.blocks.fold == f].sum() > 0 for f in np.unique(base.blocks.fold)]) < MOST:
            reason = "folds disagree"
        elif not any(q.excludes_null for q in parameters):
            reason = "its parameters may be at their null values"
        elif any(q.at_bound for q in parameters):
            reason = "a parameter has run to its bound"
        return Finding(
            label(c.effect, among),
            c.effect.target,
            c.effect.family,
            parameters,
            share,
            low,
            high,
            p,
            sign_flip_p(gain, rng),
            not reason,
            step,
            removed(base, c),
            reason,
        )

    def parallel(self, work: Callable[..., T], tasks: Sequence[tuple[Any, ...]], text: str, span: float) -> list[T]:
        """Do independent pieces of work, in processes where more than one is allowed; results in the tasks' order."""
        results: list[T] = []
        for i, result in enumerate(self.results(work, tasks)):
            results.append(result)
            self.progress(self._done + span * (i + 1) / max(len(tasks), 1), f"{text}, {i + 1} of {len(tasks)}")
        self._done += span
        return results

    def settling(self, work: Callable[..., ProfilePoint], tasks: Sequence[tuple[Any, ...]]) -> list[ProfilePoint]:
        """Do the looks around a fit, see `settled`."""
        return self.parallel(work, tasks, "looking around", 0.0)

    def results(self, work: Callable[..., T], tasks: Sequence[tuple[Any, ...]]) -> Iterable[T]:
        """Yield the results of independent pieces of work in the tasks' order."""
        return _run_all(work, tasks, self.cfg.jobs)

    def conclude(
        self, nodes: Sequence[FittedModel], detectable: tuple[Detectable, ...], issues: Sequence[str]
    ) -> Diagnosis:
        """Return the verdict."""
        first, last = nodes[0].ratio, nodes[-1].ratio
        beyond = max(first**2 - 1.0, 1e-9)
        unexplained = float(np.clip((last**2 - 1.0) / beyond, 0.0, 1.0)) if first > self.cfg.adequate else 0.0
        unknown = unknown_force(nodes, self.cfg, lambda work, tasks: _run_all(work, tasks, self.cfg.jobs))
        verdict: Verdict = "none_needed"
        if last > self.cfg.adequate or unknown is not None:
            verdict = "none_of_these"
        elif len(nodes) > 1:
            verdict = "group" if any(len(group) > 1 for group in self.groups) else "effect"
        return Diagnosis(
            verdict=verdict,
            effects=tuple(sorted(self.findings, key=lambda f: (not f.accepted, f.step, -f.gain))),
            groups=tuple(self.groups),
            where=self.places(nodes[0]) if verdict != "none_needed" else (),
            unexplained=unexplained if unknown is None else max(unexplained, unknown.share),
            ratio=tuple(n.ratio for n in nodes),
            detectable=detectable,
            next_experiment=self.experiment() if verdict != "none_needed" else None,
            issues=tuple(issues),
            models=tuple(n.model for n in nodes),
            seed=self.cfg.seed,
            unknown_force=unknown,
        )

    def experiment(self) -> str | None:
        """Return what would tell apart the first effects that the data cannot; None where there is nothing to tell."""
        open_ones = [found for found in self.hypotheses if len(found) > 1]
        if not open_ones or not self.cfg.explain:
            return None
        found = suggest(open_ones[0], self.recording, self.engine, self.cfg.seed)
        return None if found is None else found.sentence

    def places(self, given: FittedModel) -> tuple[dict[str, Any], ...]:
        """Return where the model as given fails; forces are looked for no longer than the diagnosis has taken."""
        if not self.cfg.explain:
            return ()
        spent = min(time.monotonic() - self._began, LONGEST_SEARCH)
        return tuple(
            where(
                given.model,
                self.recording,
                self.engine,
                windows=given.windows,
                offsets=given.fit.offsets,
                seconds=spent,
            )
        )


LONGEST_SEARCH = 60.0
"""Longest search for missing forces [s]."""
FIRST = 3
"""Candidates that are fitted at a time before it is asked whether more are needed."""
EXPLAINED = 1.1
"""Residual over noise at which a candidate has left little to others."""
DISTANT = 0.3
"""Share of the best gain below which a promise is not worth a fit any more where that has left little."""
NEAR = 0.7
"""Share of the best gain from which on a candidate is worth a second fit."""
CLOSE = 0.85
"""Share of the best gain from which on a candidate may be its equal."""
SETTLED = 1.03
"""Residual over noise at which a fit needs no second one."""
QUIET = 0.25
"""Share of the blocks, those with the smallest residuals, that tell what noise there is at least."""
PIECE = 0.4
"""Length of the short windows by way of which fits are led out of a local minimum [s]."""
HALF = 0.5
"""Share of the best gain from which on that is worth a try, where no candidate explains the data; and initial states
of the best, where it does; and a fit at all, where it has left nothing."""
ROUNDS, FINE = 3, 0.01
"""How often the best fits are taken up again, as long as the cost of one falls by the second number."""
DOUBTFUL = 0.4
"""Gain below which it is made sure that it is not owed to better initial states alone."""
STRONGEST = 3
"""Rivals whose initial states are tried on the model that they beat; and whose values are looked around to tell them
apart."""
WIDER = 1.25
"""How many times the difference at which candidates are alike may turn out to be none."""
MOST = 0.8
"""Share of the folds in which an effect must gain."""


def _run_all(work: Callable[..., T], tasks: Sequence[tuple[Any, ...]], jobs: int) -> Iterable[T]:
    """Yield the results of independent pieces of work in order, by joblib where several may run at a time.

    Where there are fewer pieces than processes, each piece runs several simulations at a time.
    """
    if jobs == 1 or len(tasks) < 2:
        return (work(*task) for task in tasks)
    from joblib import Parallel, delayed, effective_n_jobs

    threads = effective_n_jobs(jobs) // len(tasks)
    calls = (delayed(_limited)(threads, work, *task) for task in tasks)
    return cast("Iterable[T]", Parallel(n_jobs=jobs, return_as="generator")(calls))


def _limited(threads: int, work: Callable[..., T], *task: Any) -> T:
    """Do a piece of work with so many simulations at a time, one at least."""
    with at_most(threads):
        return work(*task)


def _leader(base: FittedModel, found: Sequence[Candidate]) -> Candidate:
    """Return the fit that takes away most of a node's error."""
    return max(found, key=lambda c: c.share(base))


def _quiet_ratios(base: FittedModel) -> dict[str, float]:
    """Return the root mean square of the residuals over the noise of each channel, in the quietest blocks it has."""
    blocks: dict[str, list[float]] = {}
    for window, piece, rows in zip(base.windows, base.pieces, base.blocks.of_row, strict=True):
        for r in window.readings:
            mine, of = piece.residual[r.rows] ** 2, rows[r.rows]
            blocks.setdefault(r.channel, []).extend(float(np.sqrt(mine[of == b].mean())) for b in np.unique(of))
    return {channel: float(np.quantile(values, QUIET)) for channel, values in blocks.items()}
