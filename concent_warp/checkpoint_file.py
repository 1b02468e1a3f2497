"""Checkpoint files of torch: tensors and plain data, which are read as data and never run as code."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from concent_warp.errors import ConcentError
from concent_warp.files import write_bytes
from concent_warp.limits import limits, raising

if TYPE_CHECKING:
    import torch

MAX_DEPTH = 20
"""Most levels of dictionaries, lists and tuples within one another."""
PLAIN = (bool, int, float, str, type(None))
"""Types of what is neither tensor nor container."""


def write_checkpoint(path: Path, document: Mapping[str, Any]) -> None:
    """Write nested dictionaries, lists and tuples of tensors, numbers and text to a file atomically.

    Raises:
        ConcentError: The file cannot be written, as on a full disk; an earlier one is unchanged.
    """
    import torch

    content = io.BytesIO()
    torch.save(document, content)
    write_bytes(path, content.getvalue())


def read_checkpoint(
    path: Path, *, keys: Collection[str] = (), finite: Collection[str] = (), error: type[ConcentError] = ConcentError
) -> dict[str, Any]:
    """Return what `write_checkpoint` wrote, with all tensors on the CPU; nothing in the file is run.

    Args:
        path: The file.
        keys: Keys that the document must have.
        finite: Keys under which all numbers must be finite, where the document has them.
        error: Class of the errors.

    Raises:
        ConcentError: The file is missing, too large, no checkpoint, holds more than tensors and plain data, lacks a
            key, or has a number that is not finite.
    """
    if not path.is_file():
        raise error("no such checkpoint", where=path, expected="a checkpoint file")
    _check_size(path, error)
    _check_sums(path, error)
    document = _load(path, error)
    if not isinstance(document, dict) or not set(keys) <= set(document):
        found = sorted(map(str, document)) if isinstance(document, dict) else type(document).__name__
        raise error("not a checkpoint of this kind", where=path, expected=f"the parts {sorted(keys)}", found=found)
    for name, value in _leaves(document, path, error):
        _check_leaf(name, value, path, error)
        if name.split("/")[0] in finite:
            _check_finite(name, value, path, error)
    return document


def _check_size(path: Path, error: type[ConcentError]) -> None:
    """Raise an error unless a file is an archive of bounded size, compressed and not."""
    try:
        size = path.stat().st_size
        with zipfile.ZipFile(path) as archive:
            size = max(size, sum(entry.file_size for entry in archive.infolist()))
    except OSError as reason:
        raise error("the checkpoint cannot be read", where=path, found=reason.strerror) from None
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as reason:
        raise error("not a checkpoint", where=path, expected="an archive of torch.save", found=reason) from None
    most = limits().checkpoint_bytes
    if size > most:
        fix = raising("checkpoint_bytes")
        raise error("the checkpoint is too large", where=path, expected=f"at most {most} bytes", found=size, fix=fix)


def _check_sums(path: Path, error: type[ConcentError]) -> None:
    """Raise an error unless all parts of an archive have their checksums, which torch does not compare."""
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
    except Exception as reason:  # zipfile and its decompressors raise whatever they do
        raise error("not a checkpoint", where=path, found=" ".join(str(reason).split())[:200]) from None
    if damaged is not None:
        raise error(
            "the checkpoint is damaged",
            where=path,
            found=f"another checksum of {damaged}",
            fix="take an earlier checkpoint or another copy",
        )


def _load(path: Path, error: type[ConcentError]) -> Any:
    """Return the content of a file that torch reads without running code."""
    import pickle
    import warnings

    import torch

    try:
        with warnings.catch_warnings(action="ignore"):
            return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as reason:
        named = re.search(r"(?:GLOBAL|global:?) ([\w.]+)", str(reason))
        raise error(
            "not a checkpoint of tensors and plain data, so it is not read",
            where=path,
            found="damaged data" if named is None else f"a call of {named[1]}",
            fix="take checkpoints only from those whom you trust",
        ) from None
    except Exception as reason:  # torch reports damage as RuntimeError, EOFError, KeyError, AttributeError and more
        found = " ".join(str(reason).split())[:200] or type(reason).__name__
        raise error("not a checkpoint", where=path, found=found) from None


def _leaves(
    value: Any, path: Path, error: type[ConcentError], name: str = "", depth: int = 0
) -> Iterator[tuple[str, Any]]:
    """Yield all that is not a container, by its keys and indices joined by "/"."""
    if depth > MAX_DEPTH:
        raise error("the checkpoint is nested too deeply", where=path, expected=f"at most {MAX_DEPTH} levels")
    parts: Any = None
    if isinstance(value, dict):
        parts = value.items()
    elif isinstance(value, list | tuple):
        parts = enumerate(value)
    if parts is None:
        yield name, value
        return
    for key, part in parts:
        yield from _leaves(part, path, error, f"{name}/{key}" if name else str(key), depth + 1)


def _check_leaf(name: str, value: Any, path: Path, error: type[ConcentError]) -> None:
    """Raise an error unless a value is a number, text, None, or a tensor whose elements are all stored."""
    import torch

    if isinstance(value, PLAIN):
        return
    if not isinstance(value, torch.Tensor):
        raise error(f"{name} is no tensor and no plain data", where=path, found=type(value).__name__)
    stored = (
        value.layout == torch.strided
        and value.device.type == "cpu"
        and not value.is_quantized
        and value.numel() * value.element_size() <= value.untyped_storage().nbytes()
    )
    if not stored:
        raise error(f"the tensor {name} has elements that are not stored", where=path, found=tuple(value.shape))


def _check_finite(name: str, value: Any, path: Path, error: type[ConcentError]) -> None:
    """Raise an error if a number or an element of a tensor is not finite."""
    import torch

    if isinstance(value, float):
        value = torch.tensor(value)
    if isinstance(value, torch.Tensor) and not bool(value.isfinite().all()):
        count = int((~value.isfinite()).sum())
        what = f"{count} of its {value.numel()} numbers are NaN or infinite" if value.ndim else str(float(value))
        raise error(f"{name} is not finite", where=path, found=what, fix="take an earlier checkpoint")


def check_state(
    found: Any, expected: Mapping[str, torch.Tensor], what: str, *, where: object, error: type[ConcentError]
) -> None:
    """Raise an error unless a state dict has the names and shapes of another one.

    Args:
        found: The state dict that was read.
        expected: State dict of the module that it is for.
        what: What the state is of, as in "the policy's network".
        where: Named in the error.
        error: Class of the error.
    """
    import torch

    def shape(state: Any, name: str) -> str:
        value = state.get(name)
        if not isinstance(value, torch.Tensor):
            return "no tensor" if name in state else "none"
        return f"{tuple(value.shape)} of {'real' if value.is_floating_point() else 'whole'} numbers"

    if not isinstance(found, Mapping):
        raise error(f"{what} has no state", where=where, found=type(found).__name__)
    for name in [*expected, *(name for name in found if name not in expected)]:
        wanted, given = (shape(state, name) for state in (expected, found))
        if wanted != given:
            raise error(
                f"{what} has another architecture", where=where, expected=f"{name} {wanted}", found=f"{name} {given}"
            )
