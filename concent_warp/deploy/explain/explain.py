"""Why trials of a policy failed, from what was commanded and measured in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.checks import check_settings
from concent_warp.deploy.explain.arm_alone import in_whole_scene, with_arm_alone
from concent_warp.deploy.explain.cfg import ExplainCfg
from concent_warp.deploy.explain.contact_windows import WindowSimulation
from concent_warp.deploy.explain.evidence import Evidence, Judge
from concent_warp.deploy.explain.failure_rate import FailureRates
from concent_warp.deploy.explain.measured_start import MeasuredStart
from concent_warp.deploy.explain.own_simulation import OwnSimulation, SimulatedTrials
from concent_warp.deploy.explain.policy_evidence import other_action
from concent_warp.deploy.explain.pose_bias import PoseBias, PoseBiasSearch, corrected
from concent_warp.deploy.explain.prepared import Preparation, PreparedTrial
from concent_warp.deploy.explain.replay_trial import Replayer
from concent_warp.deploy.explain.result import Explanation
from concent_warp.deploy.explain.whole_trials import better_in_whole_trials
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.diagnosis.result import Diagnosis, Finding
from concent_warp.diagnosis.tasks import Progress, ignore_progress
from concent_warp.effects.registry import effect_class, effect_classes
from concent_warp.errors import ConcentError, ModelError, RecordingError, TrainError
from concent_warp.files import write_json
from concent_warp.model import Model
from concent_warp.recording.cut import beginning
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.recording import Demonstration, Recording
from concent_warp.run_folder import make_folder
from concent_warp.train.environment.observation import ObservationLayout
from concent_warp.train.observation_cfg import SensorErrorsCfg
from concent_warp.train.policy.load import Policy

JOINT_SCALE = 2.5
"""Joint errors over noise of simulated trials where there are none to take it from."""


def explain(
    policy: Policy,
    recordings: Recording | Sequence[Recording],
    cfg: ExplainCfg | None = None,
    *,
    out: str | Path | None = None,
    progress: Progress | None = None,
) -> Explanation:
    """Return why trials of a policy failed: wrong perception, other physics than the model's, or the policy itself.

    Trials that do not say whether they succeeded count as failed.

    Args:
        policy: The policy that acted; with scaled commands, `Policy.scaled` of it.
        recordings: Trials, as `evaluate` records them, or logs of a robot in the scene of the policy's model.
        cfg: Settings.
        out: Folder for what the search for a missing effect has finished, from which the same call continues after an
            interruption, and for the result, ``explanation.json``, and ``with_effects.toml``, the model with the
            missing effects.
        progress: Called with the share done, 0..1, and what is being done.

    Raises:
        RecordingError: There is no failed trial, or one lacks commands, joint readings or tracked poses.
        ModelError: A recording is of another robot than the policy's model, or there is no effect of a given name.
        TrainError: A setting is out of bounds.

    Example:
        >>> import concent_warp as cw
        >>> policy = cw.load_policy("shape_sorter")
        >>> result = cw.evaluate(policy, cw.EvaluateCfg(action_scale=0.05), episodes=1, record="trials")
        >>> trials = cw.load_recording(result.recorded)
        >>> cw.explain(policy.scaled(0.05), trials, cw.ExplainCfg(simulated=4, diagnose=False)).cause
        'policy'
    """
    cfg = cfg or ExplainCfg()
    check_settings(cfg, TrainError)
    given = [recordings] if isinstance(recordings, Recording) else list(recordings)
    found = _Explaining(policy, given, cfg, progress or ignore_progress, out).run()
    if out is not None:
        make_folder(Path(out))
        write_json(Path(out) / RESULT, found.to_json())
    return found


RESULT, FREE_MOTION, WITH_EFFECTS = "explanation.json", "free_motion.h5", "with_effects.toml"
"""Files of the result, of the robot's free motion in the trials if the effect was searched for in it, and of the model
with the missing effects if there are any."""


class _Explaining:
    """The steps of one explanation."""

    def __init__(
        self, policy: Policy, recordings: Sequence[Recording], cfg: ExplainCfg, progress: Progress,
        out: str | Path | None,
    ) -> None:  # fmt: skip
        for name in cfg.effects:
            effect_class(name)
        for recording in recordings:
            policy.run.model.check_recording(recording)
        self._policy, self._recordings, self._cfg, self._out = policy, recordings, cfg, out
        self._progress = progress
        failed = [(r, d) for r in recordings for d in r.demonstrations if not d.success]
        if not failed:
            raise RecordingError(
                "no trial failed",
                where=recordings[0].source if recordings else None,
                expected="at least one trial that did not succeed",
                found=f"{sum(len(r.demonstrations) for r in recordings)} successful ones",
            )
        self._failed, self._chosen = len(failed), failed[: cfg.most_trials]
        succeeded = [d for r in recordings for d in r.demonstrations if d.success]
        self._succeeded = succeeded[: cfg.successes]
        self._further = [*(d for _, d in failed[cfg.most_trials :]), *succeeded[cfg.successes :]][: cfg.free_pool]
        enough = math.ceil(cfg.simulated / (len(self._chosen) + len(self._succeeded)))
        self._own = OwnSimulation(policy, max(cfg.repetitions, enough), cfg.seed)
        self._preparation = Preparation(self._own.task, policy.run.model.scene.model, cfg)

    def run(self) -> Explanation:
        """Return the explanation."""
        cfg, progress = self._cfg, self._progress
        if self._out is not None:
            (Path(self._out) / WITH_EFFECTS).unlink(missing_ok=True)  # of an earlier call
        progress(0.0, "finding where the trials began")
        trials = [self._preparation.trial(d) for _, d in self._chosen]
        others = [self._preparation.trial(d) for d in self._succeeded]
        progress(0.05, "asking the policy's own simulation")
        own = self._simulate([t.start for t in (*trials, *others)], 0.05, 0.2)
        progress(0.2, "replaying simulated trials")
        evidence = self._measured(trials, others, own)
        judge = Judge(self._policy, self._own.task, cfg.judge)
        if judge.doubts_poses(evidence):
            evidence = self._with_bias(evidence, judge, trials, others)
        if judge.differs(evidence) and cfg.diagnose and not judge.is_perception(evidence):
            evidence = self._with_diagnosis(evidence, judge, others)
        if judge.cause(evidence) == "unexplained" and not judge.differs(evidence):
            evidence = self._with_rates(evidence)
        evidence = self._with_cause_in_simulation(evidence, judge)
        progress(1.0, "done")
        total = sum(len(r.demonstrations) for r in self._recordings)
        return judge.explanation(evidence, [r.source for r, _ in self._chosen], self._failed, total)

    def _simulate(self, starts: Sequence[MeasuredStart], begin: float, end: float, **options: Any) -> SimulatedTrials:
        """Run the policy's own simulation; see `OwnSimulation.run` for the options."""
        text = "asking the policy's own simulation"
        return self._own.run(starts, progress=lambda s: self._progress(begin + (end - begin) * s, text), **options)

    def _measured(
        self,
        trials: list[PreparedTrial],
        others: list[PreparedTrial],
        own: SimulatedTrials,
    ) -> Evidence:
        """Return how far the replays of trials, and of those of the own simulation, are from what was measured."""
        step = max(1, len(own.recording.demonstrations) // self._cfg.simulated)
        simulated = self._preparation.usable(own.recording.demonstrations[::step])
        replayer, contact = self._preparation.replayer, self._preparation.contact
        scale = max(1.0, float(np.median([t.joint_error for t in simulated]))) if simulated else JOINT_SCALE
        width = self._cfg.judge.window
        return Evidence(
            trials=trials,
            own=own.of_first(len(trials)),
            joint_scale=scale,
            misfit=np.array([t.misfit(replayer, contact, scale) for t in trials]),
            usual=np.array([t.misfit(replayer, contact, scale) for t in simulated] or [1.0]),
            free=_known([t.free_error for t in (*trials, *others)]),
            usual_free=_known([t.free_error for t in simulated]),
            windows=[t.windows(replayer, contact, scale, width) for t in trials],
            difference=self._difference(trials),
            usual_windows=[t.windows(replayer, contact, scale, width) for t in simulated],
        )

    def _difference(self, trials: Sequence[PreparedTrial]) -> float | None:
        """Return by how much logged actions differ from those of the policy, asked again; None without a log."""
        act, cfg = self._own.act, self._policy.run.cfg.environment.observation
        if act is None:
            return None
        size = ObservationLayout.of(self._own.task, cfg).size * cfg.history
        found = [other_action(act, size, t.demonstration) for t in trials]
        return max((one for one in found if one is not None), default=None)

    def _with_rates(self, evidence: Evidence) -> Evidence:
        """Count how often the policy fails in its own simulation from starts of trials that are drawn from all."""
        every = [d for r in self._recordings for d in r.demonstrations]
        if self._failed == len(every):  # nothing is known of how often it fails
            return evidence
        count = min(self._cfg.judge.rate_trials, len(every))
        drawn = np.random.default_rng(self._cfg.seed).permutation(len(every))[:count]
        starts = [t.start for t in self._preparation.usable([every[k] for k in sorted(drawn)])]
        if not starts:
            return evidence
        found = self._simulate(starts, 0.8, 0.95).success
        rates = FailureRates(self._failed, len(every), int((~found).sum()), found.size)
        return replace(evidence, rates=rates)

    def _with_bias(
        self, evidence: Evidence, judge: Judge, trials: list[PreparedTrial], others: list[PreparedTrial]
    ) -> Evidence:
        """Search for an error of the tracked poses; if there is one, ask the simulation again from corrected starts.

        A policy that is shown in the hand what is not there fails in simulation as well, without being weak.
        """
        cfg, address = self._cfg, self._preparation.contact.address
        text = "searching for an error of the tracked poses"
        self._progress(0.25, text)
        simulation = WindowSimulation(self._policy.run.model, self._own.task, cfg.windows, cfg.start)
        every = [simulation.windows(t.demonstration, t.readings, t.measured) for t in (*trials, *others)]
        bias = PoseBiasSearch(simulation, cfg.bias, seed=cfg.seed).run(
            every, lambda share: self._progress(0.25 + 0.2 * share, text)
        )
        evidence = replace(evidence, bias=bias.of_first(len(trials)))
        if not judge.is_perception(evidence):
            return evidence
        self._progress(0.45, "asking the policy's own simulation from corrected starts")
        moved = [corrected(t.measured, address, bias.value) for t in (*trials, *others)]
        starts = [self._preparation.contact.settled(start)[0] for start in moved]
        found = self._measured(trials, others, self._simulate(starts, 0.45, 0.5))
        return replace(found, bias=evidence.bias, starts=tuple(starts[: len(trials)]))

    def _with_diagnosis(self, evidence: Evidence, judge: Judge, others: Sequence[PreparedTrial]) -> Evidence:
        """Search for a missing effect in failed trials, and see how much of all trials' misfit it explains."""
        cfg, names, model = self._cfg, self._cfg.effects, self._policy.run.model
        tried = model
        if judge.moves_otherwise(evidence):
            names = names or _robot_effects()
            self._progress(0.45, "finding the longest free motion")
            free = self._free_motion([*evidence.trials, *others, *self._preparation.usable(self._further)])
            evidence = replace(evidence, free_motion=self._write(free))
            tried, recording = with_arm_alone(model, self._own.task, evidence.trials[0].measured.grasped, free)
            if any(not _possible(tried, [name], recording) for name in cfg.effects):
                tried, recording = model, free  # what was asked for wants the object
        else:
            recording = _joined([d for _, d in self._chosen[: cfg.diagnose_trials]], self._recordings[0])
        possible = _possible(tried, names, recording)
        if names and not possible:
            raise ModelError("none of the effects can be missing", where=model.scene.source, found=", ".join(names))
        settings = DiagnoseCfg(
            effects=possible, max_additions=cfg.additions, seconds=cfg.seconds, jobs=cfg.jobs,
            seed=cfg.seed, explain=False,
        )  # fmt: skip
        out = None if self._out is None else Path(self._out) / "diagnosis"

        def between(begin: float, end: float) -> Progress:
            return lambda share, text: self._progress(begin + (end - begin) * share, f"diagnosing: {text}")

        diagnosis = diagnose(tried, recording, settings, out=out, progress=between(0.45, 0.8))

        def explained(finding: Finding) -> np.ndarray:
            values = {p.name: p.value for p in finding.parameters}
            name = finding.name.partition("(")[0]
            return evidence.explained(self._misfit(evidence, model.add_effect(name, finding.target, values)))

        better = better_in_whole_trials(diagnosis.effects, explained, cfg.judge)
        if better is not None:
            name = better[0].name.partition("(")[0]
            again = None if self._out is None else Path(self._out) / f"diagnosis_{name}"
            alone = replace(settings, effects=(name,))
            other = diagnose(tried, recording, alone, out=again, progress=between(0.8, 0.9))
            if other.accepted:
                diagnosis, evidence = other, replace(evidence, preference=better[1])
        if tried is not model:
            diagnosis = in_whole_scene(diagnosis, model)
        after = self._misfit(evidence, diagnosis.model) if diagnosis.accepted else None
        saved = self._save(diagnosis, in_arm_alone=tried is not model)
        return replace(evidence, diagnosis=diagnosis, misfit_with_effect=after, with_effects=saved)

    def _misfit(self, evidence: Evidence, model: Model) -> np.ndarray:
        """Return the misfits of the trials' replays in a model, shape (T,)."""
        replayer, contact = Replayer(self._own.task, model), self._preparation.contact
        return np.array([t.misfit(replayer, contact, evidence.joint_scale) for t in evidence.trials])

    def _free_motion(self, trials: Sequence[PreparedTrial]) -> Recording:
        """Return trials up to where the object comes near anything but the hand, those in which this takes longest."""
        free = sorted((t for t in trials if t.free_error is not None), key=lambda t: -t.free_time)
        first = self._recordings[0]
        parts = [
            beginning(_joined([t.demonstration], first), t.free_time).demonstrations[0]
            for t in free[: self._cfg.free_trials]
        ]
        return _joined(parts, first)

    def _write(self, free_motion: Recording) -> str | None:
        """Write the free motion where there is a folder for it, and return the file."""
        if self._out is None:
            return None
        path = Path(self._out) / FREE_MOTION
        make_folder(path.parent)
        write_hdf5(free_motion, path)
        return str(path)

    def _save(self, diagnosis: Diagnosis, *, in_arm_alone: bool) -> str | None:
        """Save the model with the missing effects where there is a folder for it, and return the file.

        None where the diagnosis leaves the model as it is, and where it has other constants of the simulator in
        the arm alone: the values that go with these are not those of the whole scene.
        """
        constants = diagnosis.time_step is not None or bool(diagnosis.holding)
        if self._out is None or not (diagnosis.accepted and diagnosis.changes_model) or (in_arm_alone and constants):
            return None
        path = Path(self._out) / WITH_EFFECTS
        make_folder(path.parent)
        diagnosis.model.save(path)
        return str(path)

    def _with_cause_in_simulation(self, evidence: Evidence, judge: Judge) -> Evidence:
        """Put the cause into the policy's own simulation: does it fail there as well?"""
        self._progress(0.9, "trying the cause in the policy's own simulation")
        if judge.is_perception(evidence) and (bias := evidence.bias) is not None:
            biased = self._simulate(evidence.starts, 0.95, 1.0, sensors=self._biased(bias))
            return replace(evidence, with_cause=biased)
        diagnosis = evidence.diagnosis
        if diagnosis is None or not diagnosis.accepted:
            return evidence
        starts = [t.start for t in evidence.trials]
        try:
            return replace(evidence, with_cause=self._simulate(starts, 0.9, 1.0, model=_added(self._policy, diagnosis)))
        except ConcentError:  # training supports no such effect
            return evidence

    def _biased(self, bias: PoseBias) -> SensorErrorsCfg:
        """Return the instruments of training with an error of tracked poses."""
        sensors, task = self._policy.run.cfg.environment.observation.sensors, self._own.task
        position, rotation = bias.value[:3].tolist(), bias.value[3:].tolist()
        name = task.compiled.body(task.objects[0]).name
        return replace(
            sensors, exact=False, position_bias=tuple(position), orientation_bias=tuple(rotation), biased=(name,)
        )


def _known(values: Sequence[float | None]) -> np.ndarray:
    """Return numbers with NaN in place of None."""
    return np.array([np.nan if value is None else value for value in values], dtype=float)


def _robot_effects() -> tuple[str, ...]:
    """Return the names of the effects that act on a robot that touches nothing."""
    return tuple(n for n, kind in effect_classes().items() if kind.family == "joints" or n == "gravity_tilt")


def _possible(model: Model, names: Sequence[str], recording: Recording) -> tuple[str, ...]:
    """Return those of some effects that could be missing in a model."""
    from concent_warp.diagnosis.candidates.candidates import candidates

    channels = {c for d in recording.demonstrations for c in d.measured}
    return tuple(name for name in names if candidates(model, channels, [name]))


def _joined(trials: Sequence[Demonstration], first: Recording) -> Recording:
    """Return one recording of trials from several ones, renumbered, in the scene of the first one."""
    demonstrations = tuple(replace(d, name=f"demo_{k}", policy=None) for k, d in enumerate(trials))
    return Recording(first.scene, demonstrations, source=first.source)


def _added(policy: Policy, diagnosis: Diagnosis) -> Model:
    """Return the policy's model with the effects that were accepted."""
    return replace(policy.run.model, effects=diagnosis.model.effects)
