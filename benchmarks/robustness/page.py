"""The page of all three measurements, from the data that each stores."""

from __future__ import annotations

from typing import Any

from benchmarks.pages import read_data, write_data, write_page

NAME = "robustness"


def store(part: str, data: dict[str, Any] | None) -> None:
    """Store the data of a part, if any, and write the page."""
    stored = read_data(NAME)
    if data is not None:
        stored[part] = data
        write_data(NAME, stored)
    write_page(NAME, page(stored))


def page(stored: dict[str, Any]) -> str:
    """Return the page."""
    return "# Robustness\n" + str(list(stored))
