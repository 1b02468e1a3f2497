"""Commands that mend the cause of failed trials."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from concent_warp.deploy.explain.result import Cause
from concent_warp.deploy.setting_options import as_options
from concent_warp.diagnosis.result import Diagnosis
from concent_warp.train.policy.load import Policy
from concent_warp.train.run import DEMONSTRATION, MODEL

SETTINGS: Mapping[Cause, Mapping[str, Any]] = {
    "perception": {
        "environment.observation.sensors.position_std": 0.003,
        "environment.observation.sensors.constant_share": 0.8,
    },
    "physics": {},
    "policy": {"environment.reset.stuck.share": 0.4},
    "unexplained": {
        "environment.randomisation.friction": (0.3, 3.0),
        "environment.randomisation.stiffness": (0.8, 1.2),
    },
}
"""Settings of a training that mend a cause, by dotted name."""


def remedy(
    policy: Policy,
    cause: Cause,
    diagnosis: Diagnosis | None,
    sources: Sequence[str],
    free_motion: str | None = None,
    with_effects: str | None = None,
) -> tuple[str, ...]:
    """Return commands that mend a cause, each on the line after a comment.

    Args:
        policy: The policy.
        cause: Why its trials failed.
        diagnosis: What was found of missing effects.
        sources: Recordings of the trials.
        free_motion: Recording of the robot's free motion in the trials, if the effect was searched for in it.
        with_effects: File of the model with the missing effects, if there is one.
    """
    folder = policy.folder
    model, demonstration = shlex.quote(str(folder / MODEL)), shlex.quote(str(folder / DEMONSTRATION))
    trials = shlex.quote(sources[0])
    searched = trials if free_motion is None else shlex.quote(free_motion)
    if cause == "perception":
        return (
            "# calibrate the camera again, with the robot in view, and track with it",
            "concent calibrate NEW_VIDEO.h5 -o calibrated.h5",
            "# until then: train for errors of this size",
            f"concent train {demonstration} --model {model} --out runs/robust {as_options(SETTINGS[cause])}",
        )
    if cause == "physics" and with_effects is not None:
        return (
            "# see what the model with the missing effect explains of the trials",
            f"concent compare {trials} --model {shlex.quote(with_effects)} --baseline {model}",
            "# train again in it, over the effect's interval",
            f"concent train {demonstration} --model {shlex.quote(with_effects)} --out runs/better",
        )
    if cause == "physics":
        accepted = [] if diagnosis is None else [found.name.partition("(")[0] for found in diagnosis.accepted]
        names = " --effects " + " ".join(dict.fromkeys(accepted)) if accepted else ""
        return (
            "# add the missing effect to the model, with its intervals",
            f"concent diagnose {searched} --model {model}{names} --apply better.toml",
            "# train again in the better model",
            f"concent train {demonstration} --model better.toml --out runs/better",
        )
    if cause == "policy":
        return (
            "# train on, or longer, with more starts from states without progress",
            f"concent train {demonstration} --model {model} --out runs/longer --ppo.iterations 600 "
            f"{as_options(SETTINGS[cause])}",
            "# if commands were at their limit: allow larger steps and leads",
            f"concent train {demonstration} --model {model} --out runs/stronger --environment.action.turn-lead 0.05",
        )
    return (
        "# record more trials, also successful ones, and explain them together",
        f"concent evaluate --checkpoint {shlex.quote(str(folder))} --world reality --episodes 200 --record trials",
        "# compare the model with them, channel by channel",
        f"concent compare {trials} --model {model}",
        "# train with more randomisation",
        f"concent train {demonstration} --model {model} --out runs/wider {as_options(SETTINGS[cause])}",
    )
