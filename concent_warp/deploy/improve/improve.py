"""Rounds of improvement of a policy, from its failed trials."""

from __future__ import annotations

import re
import shlex
import shutil
import time
from dataclasses import replace
from pathlib import Path

from concent_warp.checks import check_device, check_settings
from concent_warp.deploy.cfg import EvaluateCfg
from concent_warp.deploy.improve.cfg import ImproveCfg, ImproveWorld
from concent_warp.deploy.improve.mend import advice, mend
from concent_warp.deploy.improve.page import write_rounds
from concent_warp.deploy.improve.rounds import PAGE_FILE, Ending, Improved, ImprovementRound, RoundsProgress, Step
from concent_warp.deploy.improve.steps import (
    POLICY,
    Report,
    Setting,
    check_trials,
    counted,
    explained,
    trained,
    trial_files,
    try_in_reality,
    with_effects,
)
from concent_warp.diagnosis.tasks import Progress, ignore_progress
from concent_warp.effects.registry import effect_class
from concent_warp.errors import ConcentError, RecordingError, TrainError
from concent_warp.reality.hidden.in_task import parse_effects
from concent_warp.recording.recording import Recording
from concent_warp.run_folder import (
    SETTINGS,
    check_folder,
    check_training,
    check_unchanged,
    lock_folder,
    make_folder,
    plain,
    write_settings,
)
from concent_warp.train.policy.load import Policy

FREE = ("rounds", "target")
"""Settings that may differ when rounds are continued."""


def improve(
    policy: Policy,
    recording: Recording,
    cfg: ImproveCfg | None = None,
    *,
    trials: str | Path | None = None,
    world: ImproveWorld = "robot",
    device: str | None = None,
    out: str | Path = "runs/improve",
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Improved:
    """Improve a policy by rounds: failed trials are explained, the cause is mended, the policy is trained on.

    The same call continues after an interruption at the step where it stopped, and after new trials.

    Args:
        policy: The policy to begin with, in its run folder.
        recording: Recording with the demonstration that it was trained from.
        cfg: Settings.
        trials: Folder with recordings of trials (``.h5``): of the first round in it or in ``round_1``, of later rounds
            in ``round_2`` and so on. In Reality trials that are not given are made.
        world: "robot": where the trials of a round are missing, it ends, to be called again with them. "reality": each
            policy is tried in Reality.
        device: Warp's name of the device; the first CUDA device by default, the CPU without one.
        out: Folder with a folder for each round, the result ``improve.json`` and its page ``improve.html``.
        overwrite: Start anew: rounds that are there are removed.
        progress: Called with the share of all rounds done, 0..1, and what is being done.

    Raises:
        TrainError: A setting is out of bounds, or trials changed after their round had begun.
        RecordingError: There are no trials for the first round, or the recording lacks the policy's demonstration.
        ModelError: Trials are of another robot than the policy's model, or there is no effect of a given name.
        ConcentError: The folder holds rounds with other settings, or other things.

    Example:
        >>> import concent_warp as cw
        >>> policy = cw.load_policy("shape_sorter")
        >>> slow = cw.EvaluateCfg(action_scale=0.05)
        >>> cfg = cw.ImproveCfg(rounds=1, episodes=2, target=0.0, evaluate=slow)
        >>> improved = cw.improve(policy, policy.run.recording, cfg, world="reality", out="rounds", device="cpu")
        >>> improved.ending, improved.rounds[0].trials
        ('target', 2)
    """
    cfg = cfg or ImproveCfg()
    check_settings(cfg, TrainError)
    check_device(device)
    for effect in cfg.explain.effects:
        effect_class(effect)
    folder, given = Path(out), None if trials is None else Path(trials)
    _check_world(cfg.evaluate, world, given)
    name = policy.run.recording[0].name
    if name not in [d.name for d in recording.demonstrations]:
        raise RecordingError(
            "the recording lacks the demonstration that the policy was trained from",
            where=recording.source,
            expected=name,
            found=", ".join(d.name for d in recording.demonstrations),
        )
    policy.run.model.check_recording(recording)
    check_training(policy.folder)
    settings = {**plain(cfg), "policy": str(policy.folder.resolve()), "world": world}
    check_rounds_folder(folder)
    make_folder(folder)
    with lock_folder(folder):
        if overwrite:
            _remove_rounds(folder)
        check_unchanged(folder / SETTINGS, settings, FREE, resume="the settings it was begun with")
        write_settings(folder, settings)
        setting = Setting(recording.only([name]), cfg, device)
        return _Improving(setting, policy, given, world, folder, progress or ignore_progress).run()


def check_rounds_folder(folder: Path) -> None:
    """Check that a folder is empty, holds rounds, or does not exist.

    Raises:
        ConcentError: It is a file, or holds other things.
    """
    check_folder(folder)
    if not folder.is_dir() or (folder / SETTINGS).is_file():
        return
    if any(not path.name.startswith(".") for path in folder.iterdir()):
        raise ConcentError(
            "the folder holds other things than rounds", where=folder, fix="choose another folder with --out"
        )


def _remove_rounds(folder: Path) -> None:
    """Remove the rounds of a folder, and its settings."""
    for path in folder.iterdir():
        if path.is_dir() and re.fullmatch(r"round_\d+", path.name):
            shutil.rmtree(path)
    (folder / SETTINGS).unlink(missing_ok=True)


def _check_world(cfg: EvaluateCfg, world: ImproveWorld, trials: Path | None) -> None:
    """Check where trials are to come from.

    Raises:
        RecordingError: A robot's trials are not given.
        ConcentError: There is no such hidden effect, or it is to be hidden in a robot.
    """
    if world == "reality":
        parse_effects(cfg.hide)
    elif cfg.hide:
        raise TrainError("hidden effects exist only in Reality", fix="add --world reality")
    elif trials is None:
        raise RecordingError("no trials are given", expected="a folder with recordings", fix="pass --trials")
    if trials is not None and not trials.is_dir():
        raise RecordingError("no such folder of trials", where=trials, expected="a folder with recordings (.h5)")
    if world == "robot" and not trial_files(trials, 1):
        raise RecordingError("there are no trials", where=trials, expected="recordings (.h5) of the policy's trials")


class _Improving:
    """Rounds of one policy."""

    def __init__(
        self, setting: Setting, policy: Policy, trials: Path | None, world: ImproveWorld, folder: Path,
        progress: Progress,
    ) -> None:  # fmt: skip
        self._setting, self._first, self._trials, self._world = setting, policy, trials, world
        self._folder = folder
        self._rounds: dict[int, ImprovementRound] = {}
        self._progress = RoundsProgress(setting.cfg.rounds, progress)

    def run(self) -> Improved:
        """Return the result of all rounds."""
        cfg, policy = self._setting.cfg, str(self._first.folder)
        for number in range(1, cfg.rounds + 2):
            self._rounds[number] = ImprovementRound.load(self._round_folder(number)) or ImprovementRound(number, policy)
            self._progress.measured(self._rounds.values())
            if not self._has_trials(number):
                return self._ended("waiting", *self._missing_trials(number))
            one = self._rounds[number]
            if one.rate >= cfg.target:
                return self._ended("target", f"{one.rate:.0%} of the trials succeed, as asked for.")
            if number > cfg.rounds:
                break
            if (ended := self._mended(number)) is not None:
                return ended
            policy = str(self._round_folder(number) / POLICY)
            self._write("rounds", "")
        best = max(self._rounds.values(), key=lambda one: one.rate)
        most = f"; most trials succeed with the policy of round {best.number}, {best.policy}" if best.successes else ""
        return self._ended("rounds", f"All rounds are done{most}.")

    def _round_folder(self, number: int) -> Path:
        """Return the folder of a round."""
        return self._folder / f"round_{number}"

    def _report(self, number: int, step: Step) -> Report:
        """Return what reports the progress of a step."""
        return lambda share, text: self._progress(number, step, share, text)

    def _finish(self, one: ImprovementRound, step: Step, begun: float) -> None:
        """Store a round whose step is finished."""
        one = replace(one, done=(*one.done, step), seconds=(*one.seconds, time.monotonic() - begun))
        make_folder(self._round_folder(one.number))
        one.save(self._round_folder(one.number))
        self._rounds[one.number] = one

    def _has_trials(self, number: int) -> bool:
        """Count the trials of a round, in Reality made first; return whether there are any."""
        one, folder, begun = self._rounds[number], self._round_folder(number), time.monotonic()
        if "trials" in one.done:
            check_trials(one)
            return True
        files = trial_files(self._trials, number)
        if not files and self._world == "reality":
            made, command = try_in_reality(self._setting, one, folder, self._report(number, "trials"))
            files, one = [made], replace(one, commands=(*one.commands, command))
        if files:
            self._finish(counted(self._setting, one, files), "trials", begun)
        return bool(files)

    def _missing_trials(self, number: int) -> tuple[str, tuple[str, ...]]:
        """Return what to do where a robot's trials are missing: a sentence, and commands."""
        assert self._trials is not None
        one, place = self._rounds[number], self._trials / f"round_{number}"
        sentence = (
            f"Round {number} waits for trials: deploy the policy {one.policy} on the robot and put recordings of its "
            f"trials (.h5) into {place}; then give the same command again."
        )
        commands = (
            "# write the policy for the robot's controller",
            f"concent export --checkpoint {shlex.quote(one.policy)} -o policy.onnx",
        )
        return sentence, commands

    def _mended(self, number: int) -> Improved | None:
        """Explain the failed trials of a round, and mend their cause; return the result if it ends here."""
        setting, folder = self._setting, self._round_folder(number)
        if "explain" not in self._rounds[number].done:
            begun = time.monotonic()
            make_folder(folder)
            found = explained(setting, self._rounds[number], folder, self._report(number, "explain"))
            self._finish(found, "explain", begun)
        one = self._rounds[number]
        policy = setting.policy(one.policy)
        chosen = mend(one.cause, one.effects, policy)
        if chosen.stops:
            return self._stopped(one, chosen.text)
        if "model" not in one.done:
            begun = time.monotonic()
            after, fitted = with_effects(setting, one, chosen, folder, self._report(number, "model"))
            if chosen.refit and fitted is not None and fitted.fall < setting.cfg.min_fall:
                what = f"nothing: fitted again, the effects of the model explain only {fitted.fall:.0%} more"
                return self._stopped(one, what)
            self._finish(after, "model", begun)
        if "train" not in one.done:
            begun = time.monotonic()
            report = self._report(number, "train")
            self._finish(trained(setting, self._rounds[number], chosen, folder, report), "train", begun)
        return None

    def _stopped(self, one: ImprovementRound, text: str) -> Improved:
        """Return the result where the user has to act."""
        self._rounds[one.number] = replace(one, mend=text)
        what = "calibrate and record anew" if one.cause == "perception" else "another recording is needed"
        sentence = f"Round {one.number} ends with {one.cause}: {what}."
        policy = self._setting.policy(one.policy)
        return self._ended("stopped", sentence, advice(one.cause, policy, self._setting.recording.source))

    def _ended(self, ending: Ending, reason: str, commands: tuple[str, ...] = ()) -> Improved:
        """Write the result, and return it."""
        found = self._write(ending, reason, commands)
        self._progress.end()
        return found

    def _write(self, ending: Ending, reason: str, commands: tuple[str, ...] = ()) -> Improved:
        """Write the result so far with its page, and return it."""
        rounds = tuple(self._rounds[k] for k in sorted(self._rounds))
        last = rounds[-1]
        policy = str(self._round_folder(last.number) / POLICY) if "train" in last.done else last.policy
        found = Improved(rounds, ending, reason, commands, policy)
        found.save(self._folder)
        write_rounds(self._folder / PAGE_FILE, found)
        return found
