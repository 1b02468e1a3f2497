"""All cases."""

from __future__ import annotations

from benchmarks.bad_input import (
    hdf5_recordings,
    logs,
    models,
    options,
    other_recordings,
    policies,
    scenes,
    sound_cases,
    surroundings,
)
from benchmarks.bad_input.case import Case

MODULES = (hdf5_recordings, other_recordings, logs, scenes, models, policies, options, surroundings, sound_cases)
"""Modules with a function `cases`."""


def cases() -> list[Case]:
    """Return all cases."""
    return [case for module in MODULES for case in module.cases()]
