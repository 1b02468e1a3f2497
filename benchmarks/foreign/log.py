"""A log as a laboratory has it: a model of the machine, CSV files of what was commanded and measured, and the cause."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from concent_warp.files import write_text

Kind = Literal["null", "single", "pair", "outside"]
"""Nothing hidden; one effect of the library; two; one that the library does not have."""
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class Table:
    """A CSV file: a column of time and further ones."""

    time: np.ndarray
    """Times [s], shape (samples,)."""
    columns: Mapping[str, np.ndarray]
    """Values by name of the column, each of shape (samples,), in SI units and radians."""

    def write(self, path: Path) -> None:
        """Write the file, with nine digits; a reading that was lost is an empty field."""
        rows = [",".join(("time", *self.columns))]
        for k, t in enumerate(self.time):
            values = ("" if np.isnan(v[k]) else f"{v[k]:.9g}" for v in self.columns.values())
            rows.append(",".join((f"{t:.9g}", *values)))
        write_text(path, "\n".join(rows) + "\n")


@dataclass(frozen=True)
class Recorded:
    """What was recorded of one motion."""

    measured: Mapping[str, Table]
    """Readings by name of the model's sensor."""
    actions: Mapping[str, Table]
    """Commands by name of the model's actuator."""


@dataclass(frozen=True)
class Log:
    """The log of one machine with one cause."""

    model: str
    """The model that the laboratory has of its machine, as MJCF."""
    motions: Sequence[Recorded]
    """What was recorded; each motion becomes a demonstration."""
    noise: Mapping[str, float] = field(default_factory=dict)
    """Standard deviation of one component of a sensor, where the laboratory states it."""

    def write(self, folder: Path) -> None:
        """Write the folder that `concent diagnose` reads, which must not exist yet."""
        folder.mkdir(parents=True)
        write_text(folder / "scene.xml", self.model)
        many = len(self.motions) > 1
        for k, motion in enumerate(self.motions):
            place = folder / f"demo_{k}" if many else folder
            place.mkdir(exist_ok=True)
            for sensor, table in motion.measured.items():
                table.write(place / f"measured_{sensor}.csv")
            for actuator, table in motion.actions.items():
                table.write(place / f"action_{actuator}.csv")
        if self.noise:
            write_text(folder / "noise.csv", "".join(f"{name},{std:.6g}\n" for name, std in self.noise.items()))


@dataclass(frozen=True)
class Case:
    """A log to be diagnosed, and the answers that are right."""

    machine: str
    cause: str
    """Name of the cause, unique in its machine."""
    kind: Kind
    accepted: tuple[tuple[str, ...], ...]
    """Of each hidden effect the names in the library that count as right, fixed before any diagnosis."""
    make: Callable[[], Log]

    @property
    def name(self) -> str:
        """Name of the log."""
        return f"{self.machine}-{self.cause}"
