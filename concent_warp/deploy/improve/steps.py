"""The steps of a round, each by the function that has a command of its own."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from concent_warp.deploy.cfg import EvaluateCfg
from concent_warp.deploy.evaluate import evaluate
from concent_warp.deploy.explain.cfg import ExplainCfg
from concent_warp.deploy.explain.explain import FREE_MOTION, WITH_EFFECTS, explain
from concent_warp.deploy.explain.page import write_explanation
from concent_warp.deploy.improve.cfg import ImproveCfg
from concent_warp.deploy.improve.mend import Mend, missing_effects
from concent_warp.deploy.improve.rounds import ImprovementRound, MissingEffect
from concent_warp.deploy.setting_options import as_options, changed_settings, with_settings
from concent_warp.errors import TrainError
from concent_warp.files import claimed_files
from concent_warp.fit.effects.fit import FittedEffects, fit_effects
from concent_warp.model import Model
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.load import load_recording
from concent_warp.recording.merge import merged
from concent_warp.recording.recording import Recording
from concent_warp.run_folder import make_folder
from concent_warp.train.cfg import TrainCfg
from concent_warp.train.policy.load import Policy
from concent_warp.train.run import EVENTS, MODEL
from concent_warp.train.train import train

Report = Callable[[float, str], None]
"""Called with the share of the step that is done, 0..1, and what is being done."""
FAILED, EXPLANATION, PAGE, POLICY = "failed.h5", "explanation", "explanation.html", "policy"
"""In the folder of a round: failed trials that effects are fitted to, the explanation and its page, the new policy."""
SUFFIXES = (".h5", ".hdf5")


@dataclass(frozen=True)
class Setting:
    """What all rounds have in common."""

    recording: Recording
    """Holds the demonstration that policies are trained from, alone."""
    cfg: ImproveCfg
    device: str | None

    def policy(self, folder: str) -> Policy:
        """Return a policy that was trained, or one that comes with the package."""
        return Policy.load(folder)

    def scaled(self, policy: Policy) -> Policy:
        """Return a policy with the scales of its commands in the trials."""
        return policy.scaled(self.cfg.evaluate.action_scale, self.cfg.evaluate.setpoint_lead_scale)


def trial_files(folder: Path | None, number: int) -> list[Path]:
    """Return the recordings of a round's trials: in ``round_N`` of a folder, of the first one also in itself."""
    if folder is None:
        return []
    places = [folder / f"round_{number}", *([folder] if number == 1 else [])]
    for place in places:
        found = sorted(p for p in place.glob("*") if p.suffix in SUFFIXES and p.is_file()) if place.is_dir() else []
        if found:
            return found
    return []


def try_in_reality(setting: Setting, one: ImprovementRound, folder: Path, report: Report) -> tuple[Path, str]:
    """Evaluate a round's policy in Reality, and return the recording of the trials and the command that it equals."""
    cfg = setting.cfg
    settings, seed = replace(cfg.evaluate, record_failures=False), cfg.seed + one.number
    with claimed_files():  # until it is written: it is read next
        recorded = evaluate(
            setting.policy(one.policy),
            settings,
            episodes=cfg.episodes,
            seed=seed,
            device=setting.device,
            out=folder / "videos",
            record=folder / "trials",
            overwrite=True,
            progress=lambda share: report(share, "trying the policy in Reality"),
        ).recorded
    assert recorded is not None
    options = as_options(changed_settings(settings, EvaluateCfg()))
    command = (
        f"concent evaluate --checkpoint {shlex.quote(one.policy)} --world reality --episodes {cfg.episodes} "
        f"--seed {seed} --record {shlex.quote(str(folder / 'trials'))}{_device(setting)} {options}"
    )
    return recorded, command.strip()


def counted(setting: Setting, one: ImprovementRound, files: list[Path]) -> ImprovementRound:
    """Return a round with its trials counted.

    Raises:
        RecordingError: One cannot be read.
        ModelError: One is of another robot than the policy's model.
    """
    model, success = setting.policy(one.policy).run.model, []
    for path in files:
        recording = load_recording(path)
        model.check_recording(recording)
        success += [d.success for d in recording.demonstrations]
    return replace(
        one,
        files=tuple(map(str, files)),
        digests=tuple(_digest(path) for path in files),
        successes=sum(success),
        trials=len(success),
    )


def check_trials(one: ImprovementRound) -> None:
    """Check that the trials of a round are those that were counted.

    Raises:
        TrainError: They have changed.
    """
    for name, digest in zip(one.files, one.digests, strict=True):
        if not Path(name).is_file() or _digest(Path(name)) != digest:
            raise TrainError(
                f"the trials of round {one.number} have changed since the round began",
                where=name,
                fix=f"put new trials into the folder round_{one.number + 1}, or start anew with --overwrite",
            )


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def explained(setting: Setting, one: ImprovementRound, folder: Path, report: Report) -> ImprovementRound:
    """Return a round with the cause of its failed trials; the explanation and its page are in its folder."""
    policy = setting.scaled(setting.policy(one.policy))
    recordings = [load_recording(path) for path in one.files]
    found = explain(policy, recordings, setting.cfg.explain, out=folder / EXPLANATION, progress=report)
    report(1.0, "writing the page of the explanation")
    write_explanation(folder / PAGE, policy, recordings, found)
    groups = () if found.diagnosis is None else found.diagnosis.groups
    scales = {n: v for n in ("action_scale", "setpoint_lead_scale") if (v := getattr(setting.cfg.evaluate, n)) != 1.0}
    options = as_options({**changed_settings(setting.cfg.explain, ExplainCfg()), **scales})
    command = (
        f"concent explain {shlex.quote(one.policy)} {' '.join(map(shlex.quote, one.files))} "
        f"--out {shlex.quote(str(folder / EXPLANATION))} --html {shlex.quote(str(folder / PAGE))} {options}"
    )
    return replace(
        one,
        cause=found.cause,
        sentences=(f"{found.headline}.", *found.sentences()),
        effects=missing_effects(found),
        indistinct=tuple(name for group in groups for name in group[1:]) if found.cause == "physics" else (),
        commands=(*one.commands, command.strip()),
    )


def with_effects(
    setting: Setting, one: ImprovementRound, chosen: Mend, folder: Path, report: Report
) -> tuple[ImprovementRound, FittedEffects | None]:
    """Return a round with the model of the next policy written, and the fit of its effects; None where none is fitted.

    Missing effects have the values and intervals of the explanation. Where it wrote no model, and where those of
    the model are fitted again, this is to the free motion that it used, or else to failed trials.
    """
    if (not chosen.effects and not chosen.refit) or _explained_model(chosen, folder) is not None:
        return one, None
    given = Path(one.policy) / MODEL
    model, commands = Model.load(given), []
    trials, out = folder / EXPLANATION / FREE_MOTION, folder / MODEL
    if not trials.is_file():
        trials = folder / FAILED
        _write_failed_trials(setting, one, trials)
    for k, effect in enumerate(chosen.effects):
        values = dict(zip(effect.parameters, effect.values, strict=True))
        model = model.add_effect(effect.name, effect.target, values)
        last = k + 1 == len(chosen.effects)
        target = out if last else folder / f"with_{k + 1}_effects.toml"
        commands.append(_add_command(effect, given, target, trials if last else None))
        given = target
    if chosen.refit:
        commands.append(_add_command(None, given, out, trials))
    fitted = fit_effects(model, load_recording(trials), out=out, progress=report)
    before = len(model.effects) - len(chosen.effects)
    found = tuple(
        MissingEffect(added.effect.name, added.effect.target, tuple(p.name for p in parameters), added.values)
        for k, (added, parameters) in enumerate(zip(fitted.model.effects, fitted.parameters, strict=True))
        if k >= before or chosen.refit
    )
    return replace(one, fitted=found, commands=(*one.commands, *commands)), fitted


def _explained_model(chosen: Mend, folder: Path) -> Path | None:
    """Return the file of the model with missing effects that the explanation of a round wrote; None without one."""
    path = folder / EXPLANATION / WITH_EFFECTS
    return path if chosen.effects and path.is_file() else None


def _write_failed_trials(setting: Setting, one: ImprovementRound, path: Path) -> None:
    """Write the first failed trials of a round as one recording."""
    every = merged([load_recording(name) for name in one.files])
    failed = [replace(d, policy=None) for d in every.demonstrations if not d.success][: setting.cfg.fit_trials]
    write_hdf5(replace(every, demonstrations=tuple(failed)), path)


def _add_command(effect: MissingEffect | None, given: Path, out: Path, trials: Path | None) -> str:
    """Return the command that adds an effect to a model, or fits the effects that it has."""
    words = ["concent", "add"]
    if effect is not None:
        words += [effect.name, *(["--target", *effect.target] if effect.target else [])]
        if effect.parameters:
            words += ["--set", *(f"{n}={v!r}" for n, v in zip(effect.parameters, effect.values, strict=True))]
    words += ["--model", str(given), *([] if trials is None else ["--fit", str(trials)]), "--out", str(out)]
    return shlex.join(words)


def trained(setting: Setting, one: ImprovementRound, chosen: Mend, folder: Path, report: Report) -> ImprovementRound:
    """Return a round whose next policy is trained, from the present one."""
    before = setting.policy(one.policy)
    paths = _explained_model(chosen, folder), folder / MODEL, before.folder / MODEL
    path = next(path for path in paths if path is not None and path.is_file())
    cfg = with_settings(training_cfg(setting.cfg, before.run.cfg, one.number), chosen.settings)
    total, demonstration = cfg.ppo.iterations, before.run.recording[0].name

    def progress(this: Any) -> None:
        report(this.iteration / total, f"training, success {this.log['success']:.0%}")

    make_folder(folder)
    train(
        Model.load(path),
        setting.recording,
        cfg,
        events=before.run.events,
        demonstration=demonstration,
        begin_with=before,
        device=setting.device,
        out=folder / POLICY,
        resume=True,
        progress=progress,
    )
    names = [setting.recording.source, "--demonstration", demonstration, "--model", str(path)]
    names += ["--events", str(before.folder / EVENTS), "--begin-with", one.policy, "--out", str(folder / POLICY)]
    command = f"concent train {shlex.join(names)}{_device(setting)} {as_options(training_settings(cfg))}"
    return replace(one, mend=chosen.text, commands=(*one.commands, command.strip()))


def training_settings(cfg: TrainCfg) -> dict[str, Any]:
    """Return the options of ``concent train`` that lead to these settings: the stage, and what is not its default."""
    stage = cfg.environment.stage
    return {"environment.stage": stage, **changed_settings(cfg, TrainCfg.for_stage(stage))}


def training_cfg(cfg: ImproveCfg, before: TrainCfg, number: int) -> TrainCfg:
    """Return the settings of a round's training, those of the policy before it with another seed and size."""
    given = {"ppo.iterations": cfg.iterations, "environment.worlds": cfg.worlds}
    changes = {name: value for name, value in given.items() if value is not None}
    return with_settings(before, {**changes, "seed": cfg.seed + number})


def _device(setting: Setting) -> str:
    """Return the option that names the device, with a space before it."""
    return "" if setting.device is None else f" --device {setting.device}"
