"""Scores of candidates on disk, so that an interrupted search continues from them with the same result."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np


class Evaluations:
    """Results by key: one line of JSON each in a file, or in memory alone.

    A search is deterministic given the results, so that one that is started again only reads those that are known.
    """

    def __init__(self, path: Path | None) -> None:
        """Read what is known; a last line that was cut off is left out."""
        self.path, self.known = path, dict[str, Any]()
        if path is not None and path.is_file():
            for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
                try:
                    row = json.loads(line)
                    self.known[str(row["key"])] = row["found"]
                except (ValueError, KeyError, TypeError):
                    continue

    def add(self, key: str, found: Any) -> None:
        """Keep a result in plain types."""
        self.known[key] = found
        if self.path is not None:
            with self.path.open("a", encoding="utf-8") as file:
                # The newline comes first too: the last line may have been cut off.
                file.write("\n" + json.dumps({"key": key, "found": found}) + "\n")


def key_of(*parts: Any) -> str:
    """Return a key of numbers, texts and arrays."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
        digest.update(b"|")
    return digest.hexdigest()[:24]
