"""What follows from an explanation: an effect to add, settings of the next training, or what the user has to do."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from concent_warp.deploy.explain.remedy import SETTINGS
from concent_warp.deploy.explain.result import Cause, Explanation
from concent_warp.deploy.improve.rounds import MissingEffect
from concent_warp.deploy.setting_options import as_options, with_settings
from concent_warp.diagnosis.result import Finding
from concent_warp.train.policy.load import Policy
from concent_warp.train.run import MODEL


@dataclass(frozen=True)
class Mend:
    """What is done about a cause; with a reason to stop, nothing."""

    text: str
    """In words."""
    effects: tuple[MissingEffect, ...] = ()
    """Effects to add to the model."""
    refit: bool = False
    """Whether the effects of the model are fitted again, without a new one."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the training that change, by dotted name."""
    stops: bool = False
    """Whether the user has to act first."""


def missing_effects(found: Explanation) -> tuple[MissingEffect, ...]:
    """Return the effects that an explanation names as missing in the physics."""
    if found.cause != "physics" or found.diagnosis is None:
        return ()
    return tuple(_missing(finding) for finding in found.diagnosis.accepted)


def _missing(finding: Finding) -> MissingEffect:
    """Return an accepted effect in plain types."""
    name, parameters = finding.name.partition("(")[0], finding.parameters
    return MissingEffect(name, finding.target, tuple(p.name for p in parameters), tuple(p.value for p in parameters))


def mend(cause: str, effects: Sequence[MissingEffect], policy: Policy) -> Mend:
    """Return what is done about the cause of a policy's failed trials.

    Args:
        cause: As `Explanation.cause`.
        effects: Missing effects that were found.
        policy: The policy.
    """
    if cause == "physics":
        if effects:
            return Mend(f"added {' and '.join(effect.name for effect in effects)} to the model", tuple(effects))
        if policy.run.model.effects:
            return Mend("fitted the effects of the model again", refit=True)
        return Mend("nothing: the robot moves otherwise than the model, but no effect was found", stops=True)
    settings = SETTINGS[cast(Cause, cause)]
    changes = with_settings(policy.run.cfg, settings) != policy.run.cfg
    if cause == "policy":
        return Mend("trained on" + (f" with {as_options(settings)}" if changes else ""), settings=settings)
    if changes:
        what = "larger errors of tracked poses" if cause == "perception" else "more randomisation"
        return Mend(f"trained with {what}: {as_options(settings)}", settings=settings)
    return Mend("nothing: it was trained with more randomisation before, and still fails", stops=True)


def advice(cause: str, policy: Policy, recording: str) -> tuple[str, ...]:
    """Return what the user has to do where no training helps: commands, each after a comment.

    Args:
        cause: As `Explanation.cause`.
        policy: The policy.
        recording: The recording of the demonstration.
    """
    if cause == "perception":
        return (
            "# calibrate the camera again, with the robot in view, track with it, and record new trials",
            "concent calibrate NEW_VIDEO.h5 -o calibrated.h5",
        )
    model, demonstration = shlex.quote(str(policy.folder / MODEL)), shlex.quote(recording)
    return (
        "# find the motion whose recording tells which effect is missing",
        f"concent suggest {demonstration} --model {model} -o motion.h5",
        "# perform it on the robot, and diagnose the model with its recording",
        f"concent diagnose {demonstration} NEW_RECORDING.h5 --model {model} --apply better.toml",
        "# train again in the better model",
        f"concent train {demonstration} --model better.toml --begin-with {shlex.quote(str(policy.folder))} "
        "--out runs/better",
    )
