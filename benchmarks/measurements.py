"""Measurements kept one by one, a line of JSON each: a run that is cut short loses none, and can be gone on with.

kept = Measurements(path, seconds=560)
for key in keys:
    if kept.wanted(key):
        kept.add(key, measure(key))
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

Row = dict[str, Any]


class Measurements:
    """Rows of a file, each under a key; of several under one key the last counts."""

    def __init__(self, path: Path, *, seconds: float | None = None) -> None:
        """Open a file, which need not exist.

        Args:
            path: File of JSON lines.
            seconds: Time after which no measurement is begun [s]; None for no limit.
        """
        self.path, self._begun, self._seconds = path, time.monotonic(), seconds
        self.rows: dict[str, Row] = {}
        self.left: list[str] = []
        """Keys that there was no time for."""
        for line in path.read_text().splitlines() if path.is_file() else []:
            try:
                row = json.loads(line)
            except json.JSONDecodeError:  # the run was cut short while it wrote the line
                continue
            self.rows[row["key"]] = row

    def wanted(self, key: str, expected: float = 0.0) -> bool:
        """Return whether a measurement is missing and there is time for it, of which it takes about `expected` [s]."""
        if key in self.rows and "error" not in self.rows[key]:
            print(f"{key}: measured before", flush=True)
            return False
        if self._seconds is not None and time.monotonic() - self._begun + expected > self._seconds:
            self.left.append(key)
            return False
        return True

    def add(self, key: str, row: Row) -> None:
        """Keep a measurement and print it."""
        row = {"key": key, **row}
        self.rows[key] = row
        self.path.parent.mkdir(parents=True, exist_ok=True)
        cut = self.path.is_file() and self.path.read_bytes()[-1:] not in (b"", b"\n")
        with self.path.open("a") as file:
            file.write("\n" * cut + json.dumps(row) + "\n")
        spent = time.monotonic() - self._begun
        print(f"[{spent:.0f} s] {json.dumps(row)[:400]}", flush=True)

    def close(self) -> None:
        """Say what is left."""
        if self.left:
            print(f"no time was left for {len(self.left)}: {', '.join(self.left)}; run the same again", flush=True)
        else:
            print("everything is measured", flush=True)
