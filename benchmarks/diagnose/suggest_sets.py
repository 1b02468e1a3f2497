"""Data sets that may end in a group, by their names, and how a second recording has resolved it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from benchmarks.diagnose.hidden_effects_data import DataSet, cases, make
from concent_warp.reality.hidden.hidden_effect import HiddenEffectOfRig
from concent_warp.reality.hidden.registry import hidden
from concent_warp.reality.record_motion import record_rig_motion
from concent_warp.reality.rigs.registry import RIGS
from concent_warp.recording.cut import beginning
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene

PART = 0.1
"""Share of each recording that is the first one: of its time, or of its throws. Short recordings leave more open."""
SHIFT = 8000
"""Added to the seeds of `hidden_effects_data.cases`, so that the data are those of no other page."""
SEEDS = 6
"""Seeds of each data set: other noise and other motions."""
STRIDE = 100
"""Between two seeds of a data set."""
Outcome = Literal["right", "wrong", "open"]


@dataclass(frozen=True)
class SuggestSet:
    """A data set of the hidden-effects benchmark whose first recording is a part of it."""

    name: str
    base: DataSet
    part: float
    repeat: int = 0
    """Which of its seeds it is made with."""


def suggest_sets() -> list[SuggestSet]:
    """Return all data sets with one or two hidden effects of the library, and one demonstration, cut to a part.

    All of them on the first seed, then on the others, since few end in a group. Rigs that perform no given motions are
    left out (`record_rig_motion`).
    """
    found = []
    for repeat in range(SEEDS):
        end = f"-{repeat}" if repeat else ""
        for case in cases():
            if case.kind not in ("single", "pair") or case.demonstrations > 1 or RIGS[case.rig].recorder is not None:
                continue
            base = replace(case, seed=case.seed + SHIFT + STRIDE * repeat)
            found.append(SuggestSet(f"{case.name}-part{end}", base, PART, repeat))
    return found


def first_recording(one: SuggestSet) -> tuple[Recording, Scene]:
    """Return the first recording of a set, and the nominal scene."""
    data = make(one.base)
    return shortened(data.recording, one.part), data.scene


def shortened(recording: Recording, part: float) -> Recording:
    """Return the first part of a recording: of several demonstrations the first ones, of one its first time."""
    count = len(recording.demonstrations)
    if count > 1:
        return replace(recording, demonstrations=recording.demonstrations[: max(round(part * count), 1)])
    return beginning(recording, part * recording.demonstrations[0].duration)


def second_recording(one: SuggestSet, motion: Recording) -> Recording:
    """Return what the rig with the same hidden effects records of given motions."""
    rig = RIGS[one.base.rig]
    effects = [h.effect for h in hidden_effects(one)]
    return record_rig_motion(rig, motion, effects, one.base.seed)


def hidden_effects(one: SuggestSet) -> list[HiddenEffectOfRig]:
    """Return the hidden effects of a set, made anew, as `make` hides them."""
    from concent_warp.reality.hidden.drives import peak_drive_force

    rig, magnitudes = RIGS[one.base.rig], dict(one.base.magnitudes)
    if "actuator_saturation" in magnitudes:
        magnitudes["actuator_saturation"] *= peak_drive_force(rig, one.base.demonstrations, one.base.seed)
    return [hidden(name, magnitude, rig) for name, magnitude in magnitudes.items()]


def plain_name(name: str) -> str:
    """Return the name of an effect without its targets in brackets."""
    return name.split("(")[0]


def open_group(groups: Sequence[Sequence[str]], truth: Sequence[str]) -> tuple[list[str], str] | None:
    """Return the first group with more than one effect, and the hidden one in it; None where there is no such group.

    Groups without a hidden effect are no question that a recording could answer rightly.
    """
    for group in groups:
        names = [plain_name(name) for name in group]
        if len(set(names)) > 1:
            known = [name for name in names if name in truth]
            return (names, known[0]) if known else None
    return None


def outcome(groups: Sequence[Sequence[str]], group: Sequence[str], true: str) -> Outcome:
    """Return how a second diagnosis has resolved a group.

    Args:
        groups: Groups of the second diagnosis.
        group: The group of the first one.
        true: The hidden effect in it.

    "right": the hidden effect is named alone, and no other effect of the group is named; "open": it is named together
    with others; "wrong": it is not named, while others are; where nothing is named the group is open too.
    """
    named = [[plain_name(name) for name in one] for one in groups]
    own = [one for one in named if true in one]
    others = set(group) - {true}
    if own:
        alone = len(set(own[0])) == 1 and not any(others & set(one) for one in named)
        return "right" if alone else "open"
    return "wrong" if any(named) else "open"


def summary(rows: Sequence[Mapping[str, Any]], method: str) -> dict[str, int]:
    """Return how often a method resolved a group: right, wrong, open, and how often it suggested nothing or failed."""
    found = {"right": 0, "wrong": 0, "open": 0, "none": 0, "time-out": 0, "error": 0}
    for row in rows:
        found[row["methods"][method]["outcome"]] += 1
    return found
