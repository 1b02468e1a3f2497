"""Names of channels and demonstrations as entries of a file.

MuJoCo allows ``/`` in a name (attached models carry prefixes such as ``left/finger``), HDF5 and file systems do not:
there ``/`` is written as ``%2F`` and ``%`` as ``%25``.
"""

from __future__ import annotations

import re

PREFIX = "demo_"
"""Every demonstration's name begins with it."""


def entry_of(name: str) -> str:
    """Return the entry under which a name is filed."""
    entry = name.replace("%", "%25").replace("/", "%2F")
    return entry.replace(".", "%2E") if entry in (".", "..") else entry


def name_of(entry: str) -> str:
    """Return the name that is filed under an entry: the inverse of `entry_of`."""
    return entry.replace("%2E", ".").replace("%2F", "/").replace("%25", "%")


def by_number(name: str) -> tuple[str | int, ...]:
    """Sort key that puts ``demo_2`` before ``demo_10``."""
    return tuple(int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name))
