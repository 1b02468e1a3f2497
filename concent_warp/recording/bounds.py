"""Limits of the size of a recording, which every reader checks before it loads data."""

from __future__ import annotations

MAX_BYTES = 8 << 30
"""Arrays of one recording, once in memory [bytes]: an hour of a hundred channels at 1 kHz, or two minutes of RGB-D."""
MAX_SAMPLES = 10_000_000
"""Samples of one channel: an hour at 2.7 kHz."""
MAX_CHANNELS = 10_000
"""Channels of one kind in one demonstration."""
MAX_DEMONSTRATIONS = 100_000
"""Demonstrations of one recording."""
MAX_SCENE_BYTES = 256 << 20
"""MJCF text, with its meshes written as numbers [bytes]."""
MAX_TEXT_BYTES = 1 << 20
"""A text attribute, such as the task [bytes]."""
MAX_FILE_BYTES = 1 << 30
"""One CSV file or one ``.pt`` toss [bytes]; HDF5 files are bounded by what they declare instead."""
MAX_INFLATION = 1100
"""Bytes in memory per byte in the file. Deflate reaches 1032 at most, so more means that data were never written."""
MAX_SCENE_COPIES = 100_000
"""Bodies that the <replicate>, <composite> and <flexcomp> elements of a scene may ask for."""
MAX_CHUNK_BYTES = 256 << 20
"""One chunk of an HDF5 dataset, uncompressed: several frames of any camera [bytes]."""
MAX_MAGNITUDE = 1e12
"""Largest number that a channel, clock or calibration may hold, in SI units."""
