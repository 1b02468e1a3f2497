"""A suggested recording: motions as commands that run, the evidence that they will bring, and their files."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from concent_warp.diagnosis.experiment.suggested import SuggestedMotion, TimeSeries
from concent_warp.files import all_or_none, write_text
from concent_warp.model import Model
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.recording import Recording
from concent_warp.scene.payloads import PAYLOAD_HEADER


@dataclass(frozen=True)
class SuggestedPair:
    """Two hypotheses, and how far the suggested recording is expected to tell them apart."""

    true: str
    """The one that is taken to be true."""
    other: str
    """The one that is refitted to old and new data."""
    evidence: float
    """Expected log likelihood ratio [nat], see `concent_warp.diagnosis.suggestion.forecast`."""
    separation: float
    """What the refit leaves of the difference of their predictions: RMS over the noise [-], in `channel`."""
    channel: str
    """Channel in which most is left."""
    resolved: bool
    """Whether the evidence suffices to exclude `other`, see `SuggestCfg.decisive`."""

    def to_json(self) -> dict[str, Any]:
        """Return the pair in plain types."""
        return dict(vars(self))


@dataclass(frozen=True)
class Suggestion:
    """The recording that best separates what a diagnosis leaves open.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> model = cw.Model.from_recording(recording)
        >>> cfg = cw.DiagnoseCfg(effects=("joint_friction",), jobs=1, explain=False)
        >>> diagnosis = cw.diagnose(model, recording, cfg)
        >>> cw.suggest(model, recording, diagnosis=diagnosis).found
        False
    """

    sentence: str
    """What to do and what it brings, or why there is nothing to suggest."""
    question: str
    """What the diagnosis leaves open."""
    name: str = ""
    """Kind of motion."""
    source: Literal["", "menu", "optimised", "random"] = ""
    """Whether it is from the menu, from the search, or at random."""
    pairs: tuple[SuggestedPair, ...] = ()
    """Every hypothesis as the true one, against every other one."""
    needed: float = 0.0
    """Evidence from which a hypothesis counts as excluded [nat]."""
    motions: tuple[SuggestedMotion, ...] = ()
    """Motions, each a demonstration of its own; none where nothing is suggested."""
    texts: tuple[str, ...] = ()
    """What to do in each of them."""
    used: Mapping[str, float] = field(default_factory=dict)
    """Largest shares of the limits of speed and force that they use [-]."""
    predictions: Mapping[str, TimeSeries] = field(default_factory=dict)
    """What each hypothesis predicts in the channel that separates most, over the first motion."""
    channel: str = ""
    """That channel."""
    models: Mapping[str, Model] = field(default_factory=dict, repr=False)
    """The hypotheses, fitted to the data at hand."""
    recording: Recording | None = field(default=None, repr=False)
    """The motions as a recording without measurements: scene, initial states and commands."""

    @property
    def found(self) -> bool:
        """Whether a motion is suggested."""
        return bool(self.motions)

    @property
    def duration(self) -> float:
        """Time that all motions take together [s]."""
        return sum(motion.duration for motion in self.motions)

    def to_json(self) -> dict[str, Any]:
        """Return the suggestion in plain types, without arrays; SI units."""
        return {
            "found": self.found,
            "sentence": self.sentence,
            "question": self.question,
            "name": self.name,
            "source": self.source,
            "duration": self.duration,
            "motions": list(self.texts),
            "payloads": [[asdict(p) for p in motion.payloads] for motion in self.motions],
            "hypotheses": list(self.models),
            "needed": self.needed,
            "pairs": [pair.to_json() for pair in self.pairs],
            "channel": self.channel,
            "limits_used": dict(self.used),
        }

    def save(self, path: str | Path) -> list[Path]:
        """Write the motions, all files or none, and return their names.

        Args:
            path: The motion file (``.h5``), which `load_recording`, ``concent replay`` and ``concent record --motion``
                read. Beside it ``STEM.csv`` has the commands over time, a column an actuator, and ``STEM.objects.csv``,
                where objects move, their poses, and ``STEM.payloads.csv``, where bodies carry weights, these; of
                several motions each has files of its own, ``STEM.2.csv``.

        Raises:
            ConcentError: Nothing is suggested, or a file cannot be written.
        """
        if self.recording is None:
            from concent_warp.errors import ConcentError

            raise ConcentError("there is no motion to write", found=self.sentence)
        path = Path(path)
        written = [path]
        with all_or_none():
            for k, motion in enumerate(self.motions):
                stem = path.stem if k == 0 else f"{path.stem}.{k + 1}"
                tables = {
                    f"{stem}.csv": command_table(motion),
                    f"{stem}.objects.csv": object_table(motion),
                    f"{stem}.payloads.csv": payload_table(motion),
                }
                for name, table in tables.items():
                    if table:
                        write_text(path.with_name(name), table)
                        written.append(path.with_name(name))
            write_hdf5(self.recording, path)
        return written


def motion_files(path: Path, count: int) -> list[Path]:
    """Return all files that `Suggestion.save` may write for some number of motions."""
    stems = [path.stem if k == 0 else f"{path.stem}.{k + 1}" for k in range(count)]
    return [
        path,
        *(path.with_name(f"{stem}{end}") for stem in stems for end in (".csv", ".objects.csv", ".payloads.csv")),
    ]


def command_table(motion: SuggestedMotion) -> str:
    """Return the commands of a motion as CSV: time [s], and a column an actuator; empty where there is none."""
    if not motion.commands:
        return ""
    time = np.unique(np.concatenate([series.time for series in motion.commands.values()]))
    time = time[(time >= 0) & (time <= motion.duration + 1e-9)]
    columns = []
    for series in motion.commands.values():
        held = np.maximum(np.searchsorted(series.time, time + 1e-9, side="right") - 1, 0)
        columns.append(series.value.ravel()[held])
    return _table(["time", *motion.commands], [time, *columns])


def object_table(motion: SuggestedMotion) -> str:
    """Return the poses of objects as CSV: time [s], x, y, z [m] and w, x, y, z of each; empty where there is none.

    The first row is where an object is to be, and `velocity` columns [m/s, rad/s] how it is to leave.
    """
    if not motion.objects:
        return ""
    names, columns = ["time"], []
    for name, moved in motion.objects.items():
        names += [
            f"{name}.{axis}" for axis in ("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx", "wy", "wz")
        ]
        columns += [*moved.position.T, *moved.orientation.T, *moved.velocity.T, *moved.angular_velocity.T]
    time = next(iter(motion.objects.values())).time
    return _table(names, [time, *columns])


def payload_table(motion: SuggestedMotion) -> str:
    """Return the weights that bodies carry as CSV, as a recording's ``payloads.csv``; empty where there is none."""
    if not motion.payloads:
        return ""
    rows = [f"{p.body},{','.join(f'{n:.9g}' for n in p.numbers)}" for p in motion.payloads]
    return "\n".join([",".join(PAYLOAD_HEADER), *rows, ""])


def _table(names: Sequence[str], columns: Sequence[np.ndarray]) -> str:
    """Return columns of numbers as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([f"{value:.9g}" for value in row] for row in zip(*columns, strict=True))
    return text.getvalue()
