"""Data sets kept in a folder, for machines on which Drake or Bullet is not installed.

python -m benchmarks.independent.data_sets --save FOLDER           # where they are
python -m benchmarks.independent --recordings FOLDER               # where they are not
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from benchmarks.independent.data_set import Data, DataSet, Truth
from concent_warp.files import write_text
from concent_warp.recording.formats.hdf5 import read_hdf5, write_hdf5
from concent_warp.scene.scene import Scene


def save(case: DataSet, data: Data, folder: Path) -> None:
    """Write what making a data set returned: two recording files, and what is hidden, last."""
    folder.mkdir(parents=True, exist_ok=True)
    write_hdf5(data.recording, folder / f"{case.name}.h5")
    write_hdf5(data.held_out, folder / f"{case.name}.held_out.h5")
    write_text(_truth(case, folder), json.dumps([asdict(t) for t in data.truth]) + "\n")


def is_kept(case: DataSet, folder: Path | None) -> bool:
    """Return whether the folder holds a data set."""
    return folder is not None and _truth(case, folder).is_file()


def load(case: DataSet, folder: Path) -> Data:
    """Return a data set as `save` wrote it."""
    recording, held_out = (read_hdf5(folder / f"{case.name}{part}.h5") for part in ("", ".held_out"))
    truth = [Truth(**t | {"target": tuple(t["target"])}) for t in json.loads(_truth(case, folder).read_text())]
    return Data(recording, held_out, Scene(recording.scene), tuple(truth))


def _truth(case: DataSet, folder: Path) -> Path:
    """Return the file of what is hidden in a data set."""
    return folder / f"{case.name}.truth.json"
