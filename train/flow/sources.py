"""Episodes of one or several LeRobot data sets, one after another, as if they were those of one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from concent_warp.errors import RecordingError, TrainError
from concent_warp.recording.logs.readers.lerobot import LeRobotLog
from concent_warp.recording.logs.readers.log import Episode


class EpisodeSources:
    """The episodes of data sets, numbered anew from 0."""

    def __init__(self, logs: Sequence[LeRobotLog]) -> None:
        """Number the episodes.

        Args:
            logs: Data sets, at least one.

        Raises:
            TrainError: They have different rates.
        """
        self.logs = tuple(logs)
        self.rate = logs[0].rate
        """Frames a second [Hz]."""
        for log in logs:
            if log.rate != self.rate:
                expected = f"{self.rate:g} frames/s as in {logs[0].source}"
                raise TrainError("the data sets have different rates", where=log.source, expected=expected,
                                 found=f"{log.rate:g}")  # fmt: skip
        self._places: list[tuple[LeRobotLog, int]] | None = None

    @property
    def source(self) -> str:
        """Folders of the data sets, for messages."""
        return ", ".join(str(log.source) for log in self.logs)

    @property
    def numbers(self) -> Sequence[int]:
        """Numbers of the episodes."""
        return range(len(self._found()))

    def episode(self, number: int) -> Episode:
        """Return an episode; see `LeRobotLog.episode`."""
        log, own = self._found()[number]
        return log.episode(own)

    def features(self, number: int) -> dict[str, dict[str, Any]]:
        """Return the features of the data set of an episode."""
        return self._found()[number][0].features

    def where(self, number: int) -> str:
        """Return where an episode is, for messages."""
        log, own = self._found()[number]
        return f"{log.source}, episode {own}"

    def _found(self) -> list[tuple[LeRobotLog, int]]:
        """Return data set and own number of each episode, which are read when they are needed."""
        if self._places is None:
            self._places = [(log, number) for log in self.logs for number in log.numbers]
        return self._places


def open_dataset(*sources: Path) -> EpisodeSources:
    """Return the episodes of LeRobot data sets.

    Raises:
        RecordingError: There is none in a folder, or it is of another version.
        TrainError: None is given, one is given twice, or they have different rates.
    """
    if not sources:
        raise TrainError("no data set is given", expected="the folder of one or more")
    resolved = [source.resolve() for source in sources]
    for k, source in enumerate(sources):
        if resolved.index(resolved[k]) < k:
            raise TrainError("a data set is given twice", found=source)
        if not (source / "meta" / "info.json").is_file():
            found = "no such folder" if not source.exists() else "a file" if source.is_file() else "no meta/info.json"
            fix = "concent render and concent export --recording write one"
            raise RecordingError("no LeRobot data set", where=source, expected="its folder", found=found, fix=fix)
    return EpisodeSources([LeRobotLog(source) for source in sources])
