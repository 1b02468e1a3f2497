"""Settings of the contact event extraction and the staging."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from concent_warp.errors import EventsError


@dataclass(frozen=True)
class StagingCfg:
    """How contacts are filtered and how stages and their target events are found.

    Example:
        >>> import concent_warp as cw
        >>> cw.StagingCfg(blip=0.05).blip
        0.05
    """

    gap: float = 0.05
    """Breaks of a contact shorter than this are closed [s]."""
    blip: float = 0.03
    """Contacts shorter than this, after closing breaks, are dropped [s]."""
    initial: float = 0.1
    """Contacts that begin up to this time are the context the task starts in, and open no stage [s]."""
    window: float = 0.1
    """Length of the windows that forces are summed over and target events are read from [s]."""
    persist: float = 0.05
    """A grasp or a contact inside another object counts once it has lasted this long [s]."""
    squeeze: float = 0.5
    """The robot grasps an object when its forces on it add up to less than this share of their magnitudes [-]."""
    moved: float = 0.005
    """An object that the robot touches without grasping it opens a stage if it is moved by more than this [m]."""
    approach: float = 0.01
    """Length of path before the first contact of two objects from which the direction of approach is taken [m]."""
    depth: float = 0.003
    """An object is inside another once it is this far beyond the plane of their first contact [m]."""
    share: float = 0.5
    """A pair belongs to a target event if it touched during this share of the window [-]."""
    target: Literal["settled", "transition"] = "settled"
    """Which configuration of a stage is its target event: the last steady one of the stage, before the object is
    released or the next stage begins, or the one at the transition (the literal reading of the paper)."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "target" and not 0 <= value < np.inf:
                raise EventsError(f"staging: {field.name} is not right", expected="a number >= 0", found=value)
        if not 0 < self.share <= 1:
            raise EventsError("staging: share is not right", expected="a number above 0, at most 1", found=self.share)
        if self.target not in ("settled", "transition"):
            raise EventsError("staging: unknown target", expected="'settled' or 'transition'", found=repr(self.target))
