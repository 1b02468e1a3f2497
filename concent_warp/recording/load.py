"""Reading of recordings of any kind; the kind is determined from the path."""

from __future__ import annotations

from pathlib import Path

from concent_warp.errors import RecordingError
from concent_warp.recording.formats.bam import read_bam
from concent_warp.recording.formats.contactnets import read_contactnets
from concent_warp.recording.formats.csv import read_csv
from concent_warp.recording.formats.hdf5 import read_hdf5
from concent_warp.recording.held import from_release
from concent_warp.recording.logs.readers.kinds import log_kind
from concent_warp.recording.naming import PREFIX
from concent_warp.recording.recording import Recording
from concent_warp.recording.spikes import without_spikes
from concent_warp.recording.still_bodies import warn_of_still_bodies
from concent_warp.recording.unwind import unwound

KINDS = (
    "an HDF5 file (.h5, .hdf5), a folder of CSV files with a scene.xml, a .pt toss or a folder of tosses, a .json log "
    "of a servo or a folder of logs"
)

LOGS = {"lerobot": "a LeRobot data set", "ros": "a ROS bag or MCAP file", "images": "a folder of images",
        "table": "a table", "bop": "a BOP data set"}  # fmt: skip


def load_recording(path: Path | str) -> Recording:
    """Read a recording of any kind.

    An HDF5 file by its suffix ``.h5`` or ``.hdf5``, a ContactNets toss by ``.pt``, a BAM log by ``.json``; a folder by
    what is in it: ``.pt`` files, or else CSV files, a ``scene.xml`` or ``demo_*`` folders, or else ``.json`` files.
    Angles of joints that begin anew after each turn are continued over the jumps, single positions far off those beside
    them are taken as missing, and times of a log that begins later than its clock are counted from its first sample,
    those of a machine without drives from when it was let go, each with a warning.

    Raises:
        RecordingError: The path is missing, of no known kind, or what is there cannot be used.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> round(recording[0].duration)  # s
        4
    """
    recording = from_release(without_spikes(unwound(_read(Path(path)))))
    warn_of_still_bodies(recording)
    return recording


def _read(path: Path) -> Recording:
    """Read a recording as it is stored."""
    if (kind := log_kind(path)) is not None and not (path / "scene.xml").exists():
        options = "" if kind == "bop" else " --model robot.xml --map robot.toml"
        fix = f"read it with `concent import {path}{options} -o demo.h5`"
        raise RecordingError(f"this is {LOGS[kind]}, not yet a recording", where=path, fix=fix)
    if path.is_dir():
        if any(path.glob("*.pt")):
            return read_contactnets(path)
        if (path / "scene.xml").exists() or any(path.glob("*.csv")) or any(path.glob(f"{PREFIX}*")):
            return read_csv(path)
        if any(path.glob("*.json")):
            return read_bam(path)
        raise RecordingError("the folder holds no recording", where=path, expected=KINDS)
    if not path.exists():
        raise RecordingError("no such recording", where=path, expected=KINDS, fix="check the path")
    if path.suffix in (".h5", ".hdf5"):
        return read_hdf5(path)
    if path.suffix == ".pt":
        return read_contactnets(path)
    if path.suffix == ".json":
        return read_bam(path)
    raise RecordingError("unknown kind of recording", where=path, expected=KINDS, found=path.suffix or "no suffix")
