"""Several recordings of the same scene as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco

from concent_warp.errors import RecordingError
from concent_warp.recording.naming import PREFIX
from concent_warp.recording.recording import Recording
from concent_warp.scene.scene import Scene

PARTS = (("joint", "njnt"), ("body", "nbody"), ("actuator", "nu"), ("sensor", "nsensor"))
"""What the scenes of recordings must have in common, and its number in a compiled model."""


def merged(recordings: Sequence[Recording]) -> Recording:
    """Return the demonstrations of all recordings, in the scene of the first.

    Demonstrations whose names are taken get the next free number.

    Args:
        recordings: At least one.

    Raises:
        RecordingError: Two scenes have other joints, bodies, actuators or sensors.
    """
    first = recordings[0]
    names = [d.name for d in first.demonstrations]
    demonstrations, free = list(first.demonstrations), 0
    own = Scene(first.scene, source=first.source).model if len(recordings) > 1 else None
    for other in recordings[1:]:
        assert own is not None
        _check_same(own, Scene(other.scene, source=other.source).model, first, other)
        for d in other.demonstrations:
            name = d.name
            while name in names:
                name, free = f"{PREFIX}{free}", free + 1
            names.append(name)
            demonstrations.append(replace(d, name=name))
    return replace(first, demonstrations=tuple(demonstrations))


def _check_same(own: mujoco.MjModel, other: mujoco.MjModel, first: Recording, second: Recording) -> None:
    """Check that two scenes have the same parts.

    Raises:
        RecordingError: They have not.
    """
    for kind, count in PARTS:
        ours, theirs = ([getattr(m, kind)(i).name for i in range(getattr(m, count))] for m in (own, other))
        if ours != theirs:
            raise RecordingError(
                f"this recording is of another scene than {first.source}",
                where=second.source,
                expected=f"the {kind} names {ours}",
                found=theirs,
                fix="give recordings of one robot and its surroundings",
            )
