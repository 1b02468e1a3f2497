"""Reading of TOML and JSON files that may be damaged, hostile or no files at all."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeGuard

from concent_warp.errors import ConcentError
from concent_warp.limits import limits, raising


def read_toml(path: Path, error: type[ConcentError] = ConcentError) -> dict[str, Any]:
    """Return the tables of a TOML file.

    Raises:
        error: It is no file, too large or no TOML.
    """
    return _parsed(path, tomllib.loads, "a TOML file", error)


def read_json(path: Path, error: type[ConcentError] = ConcentError) -> Any:
    """Return the value in a JSON file.

    Raises:
        error: It is no file, too large or no JSON.
    """
    return _parsed(path, json.loads, "a JSON file", error)


def is_number(value: Any) -> TypeGuard[int | float]:
    """Return whether a value is a finite number that a double can hold, and no truth value."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def _parsed(path: Path, parse: Callable[[str], Any], kind: str, error: type[ConcentError]) -> Any:
    """Return what `parse` makes of the text of a file."""
    if not path.is_file():
        raise error(f"not {kind}", where=path, found="no file" if path.exists() else "nothing of that name")
    if (size := path.stat().st_size) > (most := limits().document_bytes):
        raise error(
            "the file is too large", where=path, expected=f"at most {most:,} bytes", found=size,
            fix=raising("document_bytes"),
        )  # fmt: skip
    try:
        return parse(path.read_text(encoding="utf-8"))
    except RecursionError:
        raise error(f"not {kind} that can be read", where=path, found="brackets too deep in one another") from None
    except OSError as caught:
        raise error("the file cannot be read", where=path, found=caught.strerror) from None
    except ValueError as caught:  # of the parser, of UTF-8, and of integers of more than 4300 digits
        raise error(f"not {kind}", where=path, found=str(caught)[:300]) from None
