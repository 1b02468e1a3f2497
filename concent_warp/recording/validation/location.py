"""Location of an error in a recording, with which each message begins."""

from __future__ import annotations

from dataclasses import dataclass, replace

from concent_warp.errors import RecordingError


@dataclass(frozen=True)
class ErrorLocation:
    """A file, and where wanted a demonstration and a channel in it."""

    source: str
    demonstration: str = ""
    channel: str = ""

    def at(self, channel: str) -> ErrorLocation:
        """Return the place of a channel of the same demonstration, such as ``measured/cube_position``."""
        return replace(self, channel=channel)

    def error(
        self,
        what: str,
        *,
        row: int | None = None,
        expected: object = None,
        found: object = None,
        fix: str | None = None,
    ) -> RecordingError:
        """Return the error that names this place, and the row (counted from 0) where there is one."""
        parts = [self.source, self.demonstration, self.channel, "" if row is None else f"row {row}"]
        return RecordingError(
            what, where=", ".join(part for part in parts if part), expected=expected, found=found, fix=fix
        )
