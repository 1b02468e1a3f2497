"""What a folder holds: its files, those that are parts of files, and those that cannot be read."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

import numpy as np

from benchmarks.fit.resume import readable as readable_in_a_fit

VARYING = {"settings.toml", "report.html", "history.json", "train.toml", "origin.toml"}
"""Files with times, paths or the command, which differ between runs."""


def files(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files of a folder by their names."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def hashes(folder: Path) -> dict[str, str]:
    """Return hashes of the contents of all files of a folder by their names."""
    return {name: sha256(content).hexdigest() for name, content in files(folder).items()}


def is_unfinished(name: str) -> bool:
    """Return whether the name of a file, with its folders, says that it is not finished."""
    return any("partial" in part or part.endswith((".new", ".old")) for part in Path(name).parts)


def unfinished(folder: Path) -> list[str]:
    """Return the files of a folder that are not finished."""
    return [name for name in files(folder) if is_unfinished(name)]


def unreadable(folder: Path) -> list[str]:
    """Return the files of a folder under their final names that cannot be read."""
    names = [name for name in files(folder) if not is_unfinished(name)]
    return [name for name in names if not readable(folder / name)]


def readable(path: Path) -> bool:
    """Return whether a file is whole."""
    if "tfevents" in path.name:  # a log to which TensorBoard appends, and whose end it may find cut
        return True
    check = CHECKS.get(path.suffix)
    if check is None:
        return readable_in_a_fit(path)
    try:
        return check(path)
    except Exception:  # each library has errors of its own
        return False


def _torch(path: Path) -> bool:
    """Return whether a checkpoint or a TorchScript file can be read."""
    import torch

    if path.name in ("checkpoint.pt", "flow_policy.pt"):
        return isinstance(torch.load(path, map_location="cpu", weights_only=True), dict)
    return torch.jit.load(path) is not None


def _hdf5(path: Path) -> bool:
    """Return whether all datasets of an HDF5 file can be read."""
    import h5py

    with h5py.File(path, "r") as file:
        found: list[np.ndarray] = []
        file.visititems(lambda _, node: found.append(node[()]) if isinstance(node, h5py.Dataset) else None)
    return len(found) > 0


def _parquet(path: Path) -> bool:
    """Return whether a Parquet table can be read."""
    import pyarrow.parquet as pq

    return pq.read_table(path).num_rows > 0


def _video(path: Path) -> bool:
    """Return whether a video has frames and all of them can be decoded."""
    import av

    with av.open(str(path)) as container:
        return sum(1 for _ in container.decode(video=0)) == container.streams.video[0].frames > 0


def _lines(path: Path) -> bool:
    """Return whether each line of a JSONL file is JSON."""
    return all(json.loads(line) is not None for line in path.read_text().splitlines())


def _ply(path: Path) -> bool:
    """Return whether splats can be read."""
    from concent_warp.render.splats.splats import Splats

    return len(Splats.read(path).means) > 0


def _onnx(path: Path) -> bool:
    """Return whether an ONNX file is valid."""
    import onnx

    onnx.checker.check_model(onnx.load(path))
    return True


def _toml(path: Path) -> bool:
    """Return whether a TOML file is one; models are also loaded."""
    document = tomllib.loads(path.read_text())
    if document.get("format") == "concent-model":
        from concent_warp.model import Model

        return Model.load(path) is not None
    return True


def _arrays(path: Path) -> bool:
    """Return whether all arrays of an ``.npz`` file can be read."""
    with np.load(path, allow_pickle=False) as data:
        return all(data[name] is not None for name in data.files)


CHECKS: dict[str, Callable[[Path], bool]] = {
    ".pt": _torch, ".h5": _hdf5, ".hdf5": _hdf5, ".parquet": _parquet, ".mp4": _video, ".jsonl": _lines, ".ply": _ply,
    ".onnx": _onnx, ".toml": _toml, ".npz": _arrays,
}  # fmt: skip
