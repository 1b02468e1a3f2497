"""Results of finished tasks of a diagnosis in a folder, so that an interrupted one continues from them.

Each result is one ``.npz`` file of plain arrays and a JSON text, no pickle. Its name is a hash of all that the result
depends on: recording, model, settings, versions, the task and its arguments.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from concent_warp.array_file import write_arrays
from concent_warp.diagnosis.candidates.candidate import FittedCandidate, FittedModel, ScreenedCandidate
from concent_warp.diagnosis.candidates.profile_likelihood import ProfilePoint
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.tasks import Progress, TaskRunner
from concent_warp.effects.effect import AddedEffect, Effect
from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.cross_validation import Sums
from concent_warp.fit.effects.least_squares import Fit, Linear
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Recording
from concent_warp.run_folder import make_folder, versions
from concent_warp.simulate.select import EngineName

T = TypeVar("T")
KINDS = {kind.__name__: kind for kind in (ScreenedCandidate, FittedCandidate, Fit, Linear, Sums, ProfilePoint)}
"""Classes that a result consists of, besides effects and models."""


def checkpointed_runner(
    model: Model, recording: Recording, cfg: DiagnoseCfg, progress: Progress, engine: EngineName, folder: Path
) -> TaskRunner:
    """Return a runner that keeps the results of a diagnosis's tasks in a folder, beside those of other diagnoses.

    Raises:
        ConcentError: The folder cannot be made.
    """
    make_folder(folder)
    key = _fingerprint(model, recording, cfg, versions() | {"engine": engine})
    return CheckpointedRunner(cfg.jobs, progress, model, folder, key)


class CheckpointedRunner(TaskRunner):
    """Runs tasks whose results are not in a folder yet, and keeps them there."""

    def __init__(self, jobs: int, progress: Progress, model: Model, folder: Path, key: str) -> None:
        """Prepare to run tasks.

        Args:
            jobs: Processes at a time.
            progress: Called with the share done and what is being done.
            model: The diagnosed model, on whose scene and geometry those in results are.
            folder: Where results are kept.
            key: Hash of all that every result depends on.
        """
        super().__init__(jobs, progress)
        self.model, self.folder, self.key = model, folder, key

    def results(self, task: Callable[..., T], arguments: Sequence[tuple[Any, ...]]) -> Iterable[T | None]:
        """Yield results in order: those in the folder from there, others as they are known."""
        paths = [self.folder / f"{self.name(task, each)}.npz" for each in arguments]
        known = {i: found for i, path in enumerate(paths) if (found := _load(path, self.model)) is not None}
        fresh = iter(super().results(task, [each for i, each in enumerate(arguments) if i not in known]))
        for i, path in enumerate(paths):
            if i in known:
                yield known[i]
                continue
            result = next(fresh)
            # A fitted model has all of its windows, and is quickly found anew.
            if result is not None and not isinstance(result, FittedModel):
                _save(path, result)
            yield result

    def name(self, task: Callable[..., Any], arguments: Sequence[Any]) -> str:
        """Return the name of a result: a hash of the diagnosis, the task and its arguments."""
        digest = hashlib.sha256(f"{self.key} {task.__name__}".encode())
        for item in arguments:
            _add(digest, item)
        return digest.hexdigest()[:32]


def _fingerprint(model: Model, recording: Recording, cfg: DiagnoseCfg, versions: Mapping[str, str]) -> str:
    """Return a hash of a model, a recording, the settings that results depend on, and versions."""
    digest = hashlib.sha256(json.dumps(dict(versions), sort_keys=True).encode())
    _add(digest, replace(cfg, jobs=1, seconds=None))
    digest.update(model.scene.xml.encode())
    if model.geometry is not None:
        _add(digest, model.geometry)
    _add(digest, model.contact)
    for d in recording.demonstrations:
        _add(digest, [d.name, d.qpos, d.qvel])
        digest.update(repr(d.payloads).encode())
        for channels in (d.action, d.measured):
            for name, channel in channels.items():
                _add(digest, [name, channel])
    return digest.hexdigest()


def _add(digest: Any, item: Any) -> None:
    """Add a value to a hash; of a fitted model its effects, initial states and held-out errors."""
    if isinstance(item, FittedModel):
        _add(digest, [item.model, item.fit.values, list(item.fit.offsets), item.limit, item.errors])
    elif isinstance(item, Model):
        _add(digest, [[a.effect, list(a.values)] for a in item.effects])
    elif isinstance(item, Effect):
        _add(digest, [item.name, list(item.target)])
    elif isinstance(item, np.ndarray):
        digest.update(f"{item.dtype}{item.shape}".encode())
        digest.update(np.ascontiguousarray(item).tobytes())
    elif isinstance(item, Channel):
        _add(digest, [item.time, item.value, repr(item.noise_std)])
        if item.covariance is not None:
            _add(digest, item.covariance)
    elif is_dataclass(item) and not isinstance(item, type):
        _add(digest, [getattr(item, f.name) for f in fields(item)])
    elif isinstance(item, list | tuple):
        digest.update(f"[{len(item)}".encode())
        for part in item:
            _add(digest, part)
    else:
        digest.update(f"{type(item).__name__}:{item!r};".encode())


def _save(path: Path, result: Any) -> None:
    """Write a result atomically."""
    arrays: dict[str, np.ndarray] = {}
    text = json.dumps(_to_tree(result, arrays))
    write_arrays(path, {"tree": np.array(text), **arrays})


def _load(path: Path, base: Model) -> Any:
    """Return a result from its file, None where there is none or it is damaged."""
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            return _from_tree(json.loads(str(file["tree"])), file, base)
    except Exception:  # NumPy, zipfile and json raise whatever their parsers do
        return None


def _to_tree(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Return a value as a JSON tree; its arrays are put into `arrays`."""
    if isinstance(value, np.ndarray):
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {"array": name}
    if isinstance(value, Effect):
        return {"effect": value.name, "target": list(value.target)}
    if isinstance(value, Model):
        return {"model": [_to_tree(a, arrays) for a in value.effects]}
    if isinstance(value, AddedEffect):
        return {"added": _to_tree(value.effect, arrays), "values": list(value.values)}
    if type(value).__name__ in KINDS:
        return {
            "kind": type(value).__name__,
            "fields": {f.name: _to_tree(getattr(value, f.name), arrays) for f in fields(value)},
        }
    if isinstance(value, tuple | list):
        return [_to_tree(item, arrays) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"a {type(value).__name__} cannot be kept in a file")


def _from_tree(tree: Any, arrays: Mapping[str, np.ndarray], base: Model) -> Any:
    """Return the value of a tree of `_to_tree`; models are on the scene and the geometry of `base`."""
    if isinstance(tree, list):
        return tuple(_from_tree(item, arrays, base) for item in tree)
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[tree["array"]]
    if "effect" in tree:
        return effect_class(tree["effect"])(*tree["target"])
    if "model" in tree:
        return replace(base, effects=tuple(_from_tree(item, arrays, base) for item in tree["model"]))
    if "added" in tree:
        return AddedEffect(_from_tree(tree["added"], arrays, base), tuple(tree["values"]))
    parts = {name: _from_tree(item, arrays, base) for name, item in tree["fields"].items()}
    return KINDS[tree["kind"]](**parts)
