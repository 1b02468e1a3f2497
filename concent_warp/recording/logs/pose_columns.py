"""Poses that a log has as numbers of their own: columns such as ``cup_x``, ``cup_px``, ``cup.pos.x`` and ``cup_qw``."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

AXIS = re.compile(
    r"(?P<body>.*?)[\W_]*"
    r"(?P<part>(?<![A-Za-z])(?:p|pos|position|t|trans|translation|q|quat|quaternion|r|rot|rotation|o|orientation))?"
    r"[\W_]*(?P<axis>[wxyz])(?:[\W_]*(?P<unit>m|cm|mm))?[\W_]*",
    re.IGNORECASE,
)
"""A number of a pose: the name of the body, what of it, the axis, and the unit of a length."""
TURNS = ("q", "quat", "quaternion", "r", "rot", "rotation", "o", "orientation")


@dataclass(frozen=True)
class PoseColumns:
    """Channels of the pose of one body."""

    body: str
    """What their names have in common; empty where they have no more than the axes."""
    position: tuple[str, ...]
    """x, y, z."""
    orientation: tuple[str, ...]
    """w, x, y, z."""
    unit: str
    """Unit of the position, where the names state it."""


def pose_columns(names: Iterable[str]) -> list[PoseColumns]:
    """Return the poses whose seven numbers are all among the channels, in the order in which these begin."""
    places: dict[str, dict[str, str]] = {}
    turns: dict[str, dict[str, str]] = {}
    units: dict[str, str] = {}
    for name in names:
        if (hit := AXIS.fullmatch(name)) is None:
            continue
        body, part, axis = hit["body"].rstrip("_./ -"), (hit["part"] or "").lower(), hit["axis"].lower()
        (turns if part in TURNS else places).setdefault(body, {}).setdefault(axis, name)
        if part not in TURNS and hit["unit"]:
            units[body] = hit["unit"].lower()
    return [
        PoseColumns(body, tuple(place[a] for a in "xyz"), tuple(turns[body][a] for a in "wxyz"), units.get(body, ""))
        for body, place in places.items()
        if place.keys() >= set("xyz") and turns.get(body, {}).keys() >= set("wxyz")
    ]
