"""The contact event sequence E = (e_1, ..., e_S) of a demonstration (paper, section 3.1.2) and its JSON file.

SI units; names are those of the scene's bodies and geoms; what is a point or a direction is in the body frame that its
field names, so that it holds wherever the body goes. The file is described in docs/events.md.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from concent_warp.documents import read_json
from concent_warp.errors import EventsError
from concent_warp.events.cfg import StagingCfg
from concent_warp.events.decode import decode
from concent_warp.files import write_text

FORMAT = "concent-events"
VERSION = 1

Role = Literal["robot", "object", "world"]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Entity:
    """Something that can touch: a robot link, a sphere of an object, or a geom of the surroundings."""

    name: str
    """Unique: the body's name for a robot link, ``<body>_sphere<k>`` for a sphere, else the geom's name."""
    role: Role
    body: str
    """Body it belongs to."""
    sphere: int | None = None
    """Index of the sphere in the model's `ContactGeometry`."""


@dataclass(frozen=True)
class ContactInterval:
    """One contact of a pair, from its first step to its last.

    `a` comes before `b` in the order robot, object, world; of two objects the one that the robot touches for longer.
    """

    a: str
    b: str
    start: float
    """Time of the first step in contact [s]."""
    end: float
    """Time of the first step no longer in contact [s]."""
    force: float
    """Largest normal force of a step [N], summed over the contacts of the pair."""
    point: Vector
    """Mean contact point, weighted by normal force [m], frame of the body of `b`."""
    normal: Vector
    """Mean unit normal from `b` to `a`, weighted by normal force, frame of the body of `b`; zero if forces cancel."""


@dataclass(frozen=True)
class ContactPair:
    """One pair of a target event: the point that the two share, in the frames of both bodies."""

    a: str
    b: str
    point_a: Vector
    """Contact point [m], frame of the body of `a`."""
    point_b: Vector
    """Contact point [m], frame of the body of `b`."""
    normal: Vector
    """Unit normal from `b` to `a`, frame of the body of `b`: the normal of the target surface."""
    force: float
    """Mean normal force [N]."""


@dataclass(frozen=True)
class ContactEvent:
    """Target event e_s: the pairs of entities in contact in the configuration that a stage is to achieve.

    Example:
        >>> import concent_warp as cw
        >>> events = cw.load_policy("shape_sorter").run.events
        >>> event = events.stages[-1].event
        >>> len(event.pairs) > 0
        True
    """

    time: float
    """Middle of the window it was read from [s]."""
    links: tuple[str, ...]
    """Robot links in contact with objects."""
    primitives: tuple[str, ...]
    """Spheres in contact with the robot or with another object."""
    pairs: tuple[ContactPair, ...]
    """Pairs of these, sorted by names."""


@dataclass(frozen=True)
class Stage:
    """One of the S stages: from one new kind of contact to the next.

    Example:
        >>> import concent_warp as cw
        >>> events = cw.load_policy("shape_sorter").run.events
        >>> events.stages[0].name
        'pick'
    """

    name: str
    """"pick", "align" or "insert" where the contact is of that kind, else "contact <a>-<b>"; unique in a sequence."""
    start: float
    """Time of the transition that opens the stage [s]."""
    end: float
    """Start of the next stage, or end of the demonstration [s]."""
    bodies: tuple[str, str]
    """The bodies whose new contact opened the stage; "robot" stands for all robot links."""
    event: ContactEvent
    """Target event e_s."""


@dataclass(frozen=True)
class ContactEventSequence:
    """All contacts of one demonstration, its stages and their target events.

    Example:
        >>> import concent_warp as cw
        >>> events = cw.load_policy("shape_sorter").run.events
        >>> [(stage.name, round(stage.start, 1)) for stage in events.stages]
        [...]
        >>> events.save("events.json")
    """

    demonstration: str
    """Name of the demonstration."""
    timestep: float
    """Simulation time step [s]."""
    steps: int
    """Number of simulated steps K; step k starts at k * timestep."""
    settings: StagingCfg
    """Settings that the sequence was extracted with."""
    entities: tuple[Entity, ...]
    """Entities with any contact, sorted by name."""
    body_contacts: tuple[ContactInterval, ...]
    """Contacts of pairs of bodies after the chatter rule, sorted by start; `a` and `b` are body names."""
    contacts: tuple[ContactInterval, ...]
    """Contacts of pairs of entities within those, sorted by start; `a` and `b` are entity names."""
    stages: tuple[Stage, ...]
    """Stages in the order of time."""

    @property
    def duration(self) -> float:
        """Length of the demonstration [s]."""
        return self.steps * self.timestep

    @cached_property
    def entity(self) -> dict[str, Entity]:
        """Entities by name."""
        return {entity.name: entity for entity in self.entities}

    def save(self, path: str | Path) -> None:
        """Write a JSON file, in one piece or not at all; the same sequence gives the same bytes."""
        write_text(Path(path), self.to_json())

    def to_json(self) -> str:
        """Return the text of the JSON file, one record a line."""
        document: dict[str, Any] = {"format": FORMAT, "version": VERSION, **asdict(self)}
        lines = []
        for key, value in document.items():
            if isinstance(value, tuple):
                rows = ",\n".join("  " + json.dumps(row, allow_nan=False) for row in value)
                text = f"[\n{rows}\n ]" if rows else "[]"
            else:
                text = json.dumps(value, allow_nan=False)
            lines.append(f' "{key}": {text}')
        return "{\n" + ",\n".join(lines) + "\n}\n"

    @staticmethod
    def load(path: str | Path) -> ContactEventSequence:
        """Read what `save` wrote.

        Raises:
            EventsError: The file is missing, of another format, or inconsistent.
        """
        path = Path(path)
        if not path.is_file():
            raise EventsError("no such contact event sequence", where=path, expected="a .json file")
        document = read_json(path, EventsError)
        if not isinstance(document, dict) or document.pop("format", None) != FORMAT:
            raise EventsError("not a contact event sequence", where=path, expected=f'"format": "{FORMAT}"')
        if (version := document.pop("version", None)) != VERSION:
            raise EventsError("unknown version of the event file", where=path, expected=VERSION, found=version)
        sequence = decode(ContactEventSequence, document, str(path))
        sequence.check(path)
        return sequence

    def check(self, where: object) -> None:
        """Raise `EventsError` unless names and times agree with one another."""
        if self.timestep <= 0 or self.steps < 0:
            raise EventsError("time step or number of steps is not right", where=where, expected="above 0")
        pairs = [*self.contacts, *(pair for stage in self.stages for pair in stage.event.pairs)]
        if unknown := sorted({name for pair in pairs for name in (pair.a, pair.b)} - set(self.entity)):
            raise EventsError("contacts of entities that are not listed", where=where, found=unknown[:5])
        limit = self.duration + 1e-6
        for item in (*self.body_contacts, *self.contacts, *self.stages):
            if not 0 <= item.start <= item.end <= limit:
                raise EventsError(
                    "a contact or stage has times that cannot be",
                    where=where,
                    expected=f"0 <= start <= end <= {self.duration:g} s",
                    found=f"{item.start:g} to {item.end:g} s",
                )
        for stage, following in zip(self.stages, self.stages[1:], strict=False):
            if stage.end != following.start:
                raise EventsError(
                    f"stage {stage.name!r} does not end where the next one starts",
                    where=where,
                    expected=f"{following.start:g} s",
                    found=f"{stage.end:g} s",
                )
