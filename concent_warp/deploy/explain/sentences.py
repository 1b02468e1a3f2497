"""What evidence says, in sentences."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from concent_warp.deploy.explain.pose_bias import PoseBias
from concent_warp.deploy.explain.result import Cause
from concent_warp.diagnosis.result import Diagnosis

ANOTHER_POLICY = 0.05
"""Difference of logged actions from those of the policy, asked again, from which on it is another one [-]."""


def trial_sentence(
    cause: Cause,
    moment: float | None,
    left: float | None,
    numbers: Mapping[str, float | None],
    *,
    now_and_then: bool = False,
) -> str:
    """Return a sentence on one trial.

    Args:
        cause: Why it failed.
        moment: When model and measurement part, or the object stops to come nearer to its place [s].
        left: When the object leaves the band of simulated episodes [s].
        numbers: Evidence by name.
        now_and_then: Whether the policy fails in its own simulation too, but not from this start.
    """
    outside = "" if left is None else f"; outside the band of simulated episodes from {left:.2f} s on"
    success = f"{numbers['success in own simulation']:.0%} of simulated episodes from its start succeed"
    if cause == "policy":
        stalled = "" if moment is None else f"; no progress after {moment:.2f} s"
        if now_and_then:
            return f"The policy fails now and then in its own simulation too, and the replay agrees: {success}."
        limits = f"the lead of the commands at its limit in {numbers['lead at limit']:.0%} of the steps"
        return f"The policy fails in its own simulation too: {success}{stalled}; {limits}{outside}."
    if cause == "unexplained":
        return f"No cause is found: {success}, misfit {numbers['misfit']:.1f}{outside}."
    what = "An error of the tracked pose" if cause == "perception" else "Physics that the model lacks"
    share = numbers[f"explained by {cause}"]
    explained = "" if share is None else f" explains {share:.0%} of the difference"
    when = "" if moment is None else f" at {moment:.2f} s"
    return f"{what}{explained}: the model and the measurements part{when}; {success}{outside}."


def bias_sentence(bias: PoseBias) -> str:
    """Return a sentence on an error of tracked poses, and what it explains."""
    shift = ", ".join(f"{1e3 * v:+.1f}" for v in bias.value[:3])
    turn = ", ".join(f"{np.degrees(v):+.1f}" for v in bias.value[3:])
    return (
        f"If the tracker shows the object ({shift}) mm off and turned by ({turn}) degrees, short simulations from the "
        f"measured states are off by {bias.held_out:.0%} less in trials that this was not fitted to (p = {bias.p:.2g})."
    )


def free_motion_sentence(numbers: Mapping[str, float | None]) -> str:
    """Return a sentence on joints that differ in free motion."""
    return (
        f"Before the object touches anything, joints are off by {numbers['free joint error']:.0f} x noise, in "
        f"simulated trials by {numbers['free joint error of simulated trials']:.0f}: the robot moves otherwise."
    )


def diagnosis_sentences(diagnosis: Diagnosis, share: float | None) -> list[str]:
    """Return sentences on missing effects, and the share of the difference that they explain."""
    said = [f"{diagnosis.headline[0].upper()}{diagnosis.headline[1:]}.", *diagnosis.sentences()[:3]]
    return said if share is None else [*said, f"With this in the model {share:.0%} of the difference is explained."]


def other_policy_sentence(difference: float | None) -> list[str]:
    """Return a warning where the logged actions are not those of the policy."""
    if difference is None or difference <= ANOTHER_POLICY:
        return []
    by = "its observations have another size" if np.isinf(difference) else f"actions differ by up to {difference:.2f}"
    return [f"The log is not of this policy: asked again with what was observed, {by}."]
