"""What opens a stage: the first step of a new kind of contact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Kind = Literal["push", "pick", "touch", "align", "enter", "insert"]
"""Robot on object: "push", or "pick" where it grasps. Object on object: "touch", or "align" where the robot holds one;
beyond the plane of the first contact, "enter", or "insert" where the one surrounds the other."""


@dataclass(frozen=True)
class Onset:
    """A new kind of contact between two bodies."""

    kind: Kind
    step: int
    """First step of the contact."""
    body: tuple[int | None, int]
    """Body ids; None stands for the robot."""
    active: np.ndarray
    """When there is contact of this kind, shape (K,) bool."""
