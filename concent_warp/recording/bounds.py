"""Bounds of the values of a recording, and of what a file may pretend to hold."""

from __future__ import annotations

MAX_INFLATION = 1100
"""Bytes in memory per byte in the file. Deflate reaches 1032 at most, so more means that data were never written."""
MAX_MAGNITUDE = 1e12
"""Largest number that a channel, clock or calibration may hold, in SI units."""
