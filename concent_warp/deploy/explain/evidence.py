"""The evidence on failed trials, and the judgement of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import mannwhitneyu

from concent_warp.deploy.explain.cfg import JudgeCfg
from concent_warp.deploy.explain.failure_rate import FailureRates
from concent_warp.deploy.explain.measured_start import MeasuredStart
from concent_warp.deploy.explain.own_simulation import SimulatedTrials
from concent_warp.deploy.explain.policy_evidence import limits_reached, unusual_observations
from concent_warp.deploy.explain.pose_bias import PoseBias
from concent_warp.deploy.explain.prepared import PreparedTrial
from concent_warp.deploy.explain.remedy import remedy
from concent_warp.deploy.explain.result import Cause, Explanation, TrialExplanation
from concent_warp.deploy.explain.sentences import (
    bias_sentence,
    diagnosis_sentences,
    free_motion_sentence,
    other_policy_sentence,
    trial_sentence,
)
from concent_warp.diagnosis.result import Diagnosis, Finding
from concent_warp.simulate.replay import interpolate
from concent_warp.train.policy.load import Policy
from concent_warp.train.task.task import Task

MEASUREMENT = "measurement"
"""Family of the effects of instruments."""
QUANTILE = 0.95
"""Share of simulated trials below a threshold."""


@dataclass(frozen=True)
class Evidence:
    """What is known of T failed trials."""

    trials: Sequence[PreparedTrial]
    own: SimulatedTrials
    """Episodes of the policy's own simulation from the starts of the trials."""
    joint_scale: float
    """Joint errors over noise that simulated trials show [-]."""
    misfit: np.ndarray
    """Of the replays in the model, shape (T,)."""
    usual: np.ndarray
    """The same of simulated trials, shape (S,)."""
    free: np.ndarray
    """Joint errors in free motion over noise, of T failed and some successful trials; NaN for too little of it."""
    usual_free: np.ndarray
    """The same of simulated trials, shape (S,)."""
    windows: Sequence[np.ndarray]
    """Errors of the replays by window, shape (W,) each."""
    usual_windows: Sequence[np.ndarray]
    """The same of simulated trials."""
    difference: float | None = None
    """Largest difference of logged actions from those of the policy, asked again [-]; None without a log."""
    rates: FailureRates | None = None
    """How often the policy fails, where the replays agree while it succeeds in simulation from most starts."""
    bias: PoseBias | None = None
    """The error of tracked poses that explains most."""
    starts: tuple[MeasuredStart, ...] = ()
    """Starts of the trials without it, where it was accepted."""
    diagnosis: Diagnosis | None = None
    free_motion: str | None = None
    """File of the free motion that the effect was searched in, where it was and this was written."""
    with_effects: str | None = None
    """File of the model with the missing effects, where it was written."""
    preference: str | None = None
    """A sentence on why whole trials prefer its effect to one that explains as much of what it was searched for in."""
    misfit_with_effect: np.ndarray | None = None
    """Misfit with the missing effect, shape (T,)."""
    with_cause: SimulatedTrials | None = None
    """Episodes of the policy's own simulation with the cause in it."""

    @property
    def level(self) -> float:
        """Median misfit of simulated trials."""
        return float(np.median(self.usual))

    def explained(self, after: np.ndarray) -> np.ndarray:
        """Return the share of each trial's misfit above that of simulated trials that a cause explains, shape (T,)."""
        excess = np.maximum(self.misfit - self.level, 1e-9)
        return np.clip((self.misfit - after) / excess, 0.0, 1.0)


class Judge:
    """Judges evidence by the settings."""

    def __init__(self, policy: Policy, task: Task, cfg: JudgeCfg) -> None:
        self._policy, self._task, self._cfg = policy, task, cfg

    def limit(self, evidence: Evidence) -> float:
        """Return the misfit up to which a trial agrees with the model."""
        return max(float(np.quantile(evidence.usual, QUANTILE)), self._cfg.least_ratio * evidence.level)

    def differs(self, evidence: Evidence) -> bool:
        """Return whether the trials together differ from the model more than simulated ones do.

        They do where the joints differ in free motion, or the misfits of the replays are larger by a rank-sum test.
        """
        if self.moves_otherwise(evidence):
            return True
        larger = float(np.median(evidence.misfit)) > self._cfg.least_ratio * evidence.level
        found = mannwhitneyu(evidence.misfit, evidence.usual, alternative="greater")
        return larger and bool(found.pvalue <= self._cfg.significance)

    def doubts_poses(self, evidence: Evidence) -> bool:
        """Return whether an error of the tracked poses may be behind the trials.

        It is not where joints differ before anything is touched, nor where the policy fails in its own simulation from
        starts that the replays agree with.
        """
        weak = evidence.own.rate <= self._cfg.weak_policy
        credible = float(np.median(evidence.misfit)) <= self._cfg.credible_start
        return not self.moves_otherwise(evidence) and not (weak and credible)

    def moves_otherwise(self, evidence: Evidence) -> bool:
        """Return whether the robot's joints differ in free motion."""
        real, usual = (values[np.isfinite(values)] for values in (evidence.free, evidence.usual_free))
        if not len(real) or not len(usual):
            return False
        return bool(np.median(real) > self._cfg.free_ratio * np.quantile(usual, QUANTILE))

    def is_perception(self, evidence: Evidence) -> bool:
        """Return whether there is an error of tracked poses, beyond the tracker's usual ones, in all trials."""
        bias = evidence.bias
        if bias is None:
            return False
        sure = bias.p <= self._cfg.significance and bias.held_out >= self._cfg.least_gain
        return bool(sure and bias.size >= self._cfg.least_bias)

    def is_perception_by_diagnosis(self, evidence: Evidence) -> bool:
        """Return whether the diagnosis names an error of the instruments."""
        named = _named(evidence)
        return named is not None and named.family == MEASUREMENT and named.gain >= self._cfg.explained

    def is_physics(self, evidence: Evidence) -> bool:
        """Return whether the world moved otherwise than the model."""
        named = _named(evidence)
        if self.moves_otherwise(evidence) or (named is not None and named.gain >= self._cfg.explained):
            return True
        if evidence.misfit_with_effect is None:
            return False
        return bool(np.median(evidence.explained(evidence.misfit_with_effect)) >= self._cfg.explained)

    def fails_now_and_then(self, evidence: Evidence) -> bool:
        """Return whether the policy fails about as often in its own simulation as in the trials."""
        return evidence.rates is not None and evidence.rates.agree(self._cfg)

    def cause(self, evidence: Evidence) -> Cause:
        """Return the cause that all trials together show."""
        if evidence.own.rate <= self._cfg.weak_policy:
            return "policy"
        if self.is_perception(evidence):
            return "perception"
        if not self.differs(evidence):
            return "policy" if self.fails_now_and_then(evidence) else "unexplained"
        if self.is_perception_by_diagnosis(evidence):
            return "perception"
        return "physics" if self.is_physics(evidence) else "unexplained"

    def explanation(self, evidence: Evidence, sources: Sequence[str], failed: int, total: int) -> Explanation:
        """Return the judgement."""
        cause = self.cause(evidence)
        numbers = self._numbers(evidence)
        return Explanation(
            cause=cause,
            trials=tuple(self._trial(evidence, k, cause, source) for k, source in enumerate(sources)),
            failed=failed,
            total=total,
            evidence=numbers,
            remarks=tuple(self._remarks(evidence, cause, numbers)),
            remedy=remedy(
                self._policy, cause, evidence.diagnosis, sources, evidence.free_motion, evidence.with_effects
            ),
            diagnosis=evidence.diagnosis,
            bias=evidence.bias,
            simulated=evidence.own.recording,
        )

    def _numbers(self, evidence: Evidence) -> dict[str, float | None]:
        """Return the evidence of all trials together."""
        bias, effect = evidence.bias, evidence.misfit_with_effect
        return {
            "success in own simulation": evidence.own.rate,
            "success with the cause in it": None if evidence.with_cause is None else evidence.with_cause.rate,
            "failure rate of the trials": None if evidence.rates is None else evidence.rates.rate,
            "failure rate in own simulation": None if evidence.rates is None else evidence.rates.simulated_rate,
            "misfit": float(np.median(evidence.misfit)),
            "misfit of simulated trials": evidence.level,
            "misfit that agrees": self.limit(evidence),
            "free joint error": _median(evidence.free),
            "free joint error of simulated trials": _median(evidence.usual_free),
            "explained by perception": None if bias is None else float(np.median(bias.explained)),
            "held-out gain of the error of poses": None if bias is None else bias.held_out,
            "p of the error of poses": None if bias is None else bias.p,
            "explained by physics": None if effect is None else float(np.median(evidence.explained(effect))),
            "held-out gain of the effect": None if (named := _named(evidence)) is None else named.gain,
        }

    def _remarks(self, evidence: Evidence, cause: Cause, numbers: dict[str, float | None]) -> list[str]:
        """Return sentences on the evidence of all trials together."""
        said = [
            *other_policy_sentence(evidence.difference),
            f"From the same starts the policy succeeds in {evidence.own.rate:.0%} of {evidence.own.success.size} "
            "episodes in its own simulation.",
            f"Replayed in the model, the trials are {numbers['misfit']:.1f} from their measurements (mean loss in "
            f"units of noise); simulated trials {evidence.level:.1f}, up to {self.limit(evidence):.1f} agrees.",
        ]
        if evidence.rates is not None:
            said.append(evidence.rates.sentence)
        if self.moves_otherwise(evidence):
            said.append(free_motion_sentence(numbers))
        if cause == "perception" and evidence.bias is not None and self.is_perception(evidence):
            said.append(bias_sentence(evidence.bias))
        if evidence.diagnosis is not None:
            said += diagnosis_sentences(evidence.diagnosis, numbers["explained by physics"])
        if evidence.preference is not None:
            said.append(evidence.preference)
        if evidence.with_cause is not None and cause in ("perception", "physics"):
            said.append(
                f"With this in its own simulation, the policy succeeds in {evidence.with_cause.rate:.0%} of "
                f"{evidence.with_cause.success.size} episodes."
            )
        return said

    def _trial(self, evidence: Evidence, k: int, cause: Cause, source: str) -> TrialExplanation:
        """Return the judgement of one trial, given the cause that all show together."""
        trial, numbers = evidence.trials[k], self._trial_numbers(evidence, k)
        own: Cause = "unexplained"
        limit = self.limit(evidence)
        now_and_then = cause == "policy" and bool(evidence.misfit[k] <= limit)
        if float(evidence.own.success[k].mean()) <= self._cfg.weak_policy:
            own, now_and_then = "policy", False
        elif cause == "perception" and (numbers["explained by perception"] or 0.0) >= self._cfg.least_gain:
            own = cause
        elif (numbers["explained by physics"] or 0.0) >= self._cfg.explained and (
            evidence.misfit[k] > (self._cfg.least_ratio * evidence.level if cause == "physics" else limit)
        ):
            own = "physics"
        elif now_and_then:
            own = cause  # what all trials show together; the few episodes from one start tell less
        elif evidence.misfit[k] > limit and cause in ("physics", "perception"):
            own = cause  # what all trials show together; contacts may have gone another way in this replay
        usual = np.concatenate(list(evidence.usual_windows) or [np.ones(1)])
        threshold = float(max(np.quantile(usual, 0.99), self._cfg.least_ratio))
        above = np.flatnonzero(evidence.windows[k] > threshold)
        moment = float(above[0] * self._cfg.window) if len(above) and own != "policy" else self._stalled(trial)
        left = self._left(evidence, k)
        return TrialExplanation(
            name=trial.demonstration.name,
            source=source,
            cause=own,
            moment=moment,
            left_prediction=left,
            sentence=trial_sentence(own, moment, left, numbers, now_and_then=now_and_then),
            evidence=numbers,
            divergence=evidence.windows[k],
            threshold=threshold,
            window=self._cfg.window,
            start=trial.start.qpos,
        )

    def _trial_numbers(self, evidence: Evidence, k: int) -> dict[str, float | None]:
        """Return the evidence of one trial."""
        trial, bias, effect = evidence.trials[k], evidence.bias, evidence.misfit_with_effect
        first = trial.demonstration.action[next(iter(trial.demonstration.action))].time
        joints = interpolate(trial.readings.time, trial.readings.joints, first)
        free = float(evidence.free[k])
        return {
            "success in own simulation": float(evidence.own.success[k].mean()),
            "misfit": float(evidence.misfit[k]),
            "free joint error": free if np.isfinite(free) else None,
            "move of the start, mm": float(1e3 * np.linalg.norm(trial.move[:3])),
            "explained by perception": None if bias is None else float(bias.explained[k]),
            "explained by physics": None if effect is None else float(evidence.explained(effect)[k]),
            **limits_reached(self._task, trial.demonstration, joints, self._cfg.at_limit),
            "unusual observations": unusual_observations(self._policy, trial.demonstration),
        }

    def _stalled(self, trial: PreparedTrial) -> float | None:
        """Return the time after which the object came no nearer to its place [s]."""
        goal, pose = self._task.target_position, trial.readings.pose
        if goal is None:
            return None
        m, base = self._task.compiled, self._task.objects[1]
        target = m.body_pos[base] + np.asarray(goal)
        smooth = np.array([pose.position[max(0, i - 2) : i + 3].mean(axis=0) for i in range(len(pose.time))])
        return float(pose.time[np.linalg.norm(smooth - target, axis=1).argmin()])

    def _left(self, evidence: Evidence, k: int) -> float | None:
        """Return the first time at which the object was outside the band of simulated episodes [s]; None if never."""
        repetitions, width = evidence.own.success.shape[1], self._cfg.window
        pose, noise = evidence.trials[k].readings.pose, evidence.trials[k].readings.pose_std[0]
        episodes = [evidence.own.position[k * repetitions + r] for r in range(repetitions)]
        dt = self._policy.run.cfg.environment.decimation * self._task.replay.timestep
        for start in np.arange(0, pose.time[-1], width):
            inside = (pose.time >= start) & (pose.time < start + width)
            means = [_mean_between(e, dt, start, start + width) for e in episodes]
            known = np.array([mean for mean in means if mean is not None])
            if inside.sum() < 3 or not len(known):
                continue
            place, spread = pose.position[inside].mean(axis=0), known.std(axis=0)
            slack = 3 * (noise / np.sqrt(inside.sum()) + noise / 2 + spread)
            if ((place < known.min(axis=0) - slack) | (place > known.max(axis=0) + slack)).any():
                return float(start)
        return None


def _mean_between(position: np.ndarray, dt: float, start: float, end: float) -> np.ndarray | None:
    """Return the mean of positions (S, 3) at steps of `dt` within a time; None where there are none."""
    part = position[round(start / dt) : round(end / dt)]
    return part.mean(axis=0) if len(part) else None


def _named(evidence: Evidence) -> Finding | None:
    """Return the first effect that the diagnosis accepted; None where there is none."""
    return next(iter(evidence.diagnosis.accepted), None) if evidence.diagnosis is not None else None


def _median(values: np.ndarray) -> float | None:
    """Return the median of known values; None where there are none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None
