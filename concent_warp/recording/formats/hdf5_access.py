"""Safe access to the entries of an untrusted HDF5 file.

A file is data: nothing in it is executed, nothing outside it is opened (soft, external and virtual links are refused,
external storage too), and the size of an array is checked before the array is read.
"""

from __future__ import annotations

import difflib
import hashlib
import itertools
import math
import re
import warnings
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, TypeVar

import h5py
import h5py.h5l as h5l
import h5py.h5z as h5z
import numpy as np

from concent_warp.errors import RecordingError, printable
from concent_warp.limits import limits, raising
from concent_warp.recording.bounds import MAX_INFLATION
from concent_warp.recording.formats.hdf5_heap import memory_bound

KNOWN_FILTERS = {h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32, h5z.FILTER_LZF}
"""Compression and checksums that come with h5py."""
KINDS = {float: "fiu", np.float32: "f", np.uint8: "u", bool: "b"}
"""Kinds of stored numbers that are read as a type."""

CHECKSUM = "sha256"
"""Attribute of a dataset that HDF5 itself stores without a checksum: the digest of its bytes, in hexadecimal digits."""
ALL_ATTRIBUTES = (
    "format", "version", "path", "task", "success", "noise_std", "frame", "intrinsics", "pose", "body", CHECKSUM,
)  # fmt: skip
"""Attributes that are read somewhere in a recording."""
FOREIGN = re.compile(
    r"CLASS|TITLE|VERSION|FLAVOR|NAME|DIMENSION_LIST|DIMENSION_LABELS|REFERENCE_LIST|_Netcdf.*|_NC.*|PYTABLES.*"
)
"""Attributes in which other libraries keep notes of their own."""
SHOWN_ATTRIBUTES = 3
"""Attributes that are not read which a warning names."""
CLOSE_NAME = 0.75
"""Similarity of names (`difflib`) from which on an unknown attribute is taken for a misspelt one."""

Entry = TypeVar("Entry", h5py.Group, h5py.Dataset)


class SafeFile:
    """Reads entries of one open file and counts the bytes that are to be loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path
        most, size = limits(), path.stat().st_size
        self.left = min(most.recording_bytes, max(most.unpacked_bytes, most.inflation * size))
        self.bound = "recording_bytes" if self.left == most.recording_bytes else "unpacked_bytes"
        self.most = self.left
        self.unread: list[str] = []

    def error(self, what: str, entry: str | None, **details: Any) -> RecordingError:
        """Return the error about an entry of the file."""
        return RecordingError(what, where=f"{self.path}, {entry}", **details)

    def array(self, group: h5py.Group, name: str, dtype: type = float) -> np.ndarray:
        """Read an array of numbers as `dtype`, after checking what it declares."""
        dataset = self.dataset(group, name)
        entry = f"{group.name}/{name}"
        if dataset.dtype.kind not in KINDS[dtype] or (dtype is np.uint8 and dataset.dtype != np.uint8):
            raise self.error("wrong kind of data", entry, expected=np.dtype(dtype), found=dataset.dtype)
        if dataset.shape is None or len(dataset.shape) not in range(1, 5) or dataset.shape[0] > limits().samples:
            raise self.error(
                "wrong shape",
                entry,
                expected=f"1 to 4 axes, at most {limits().samples} samples",
                fix=raising("samples"),
                found=dataset.shape,
            )
        count = math.prod(dataset.shape)
        self.left -= count * max(np.dtype(dtype).itemsize, dataset.dtype.itemsize)
        if self.left < 0:
            raise self.error(
                "the recording is too large",
                entry,
                expected=f"at most {self.most} bytes in all once unpacked",
                fix=raising(self.bound),
                found=dataset.shape,
            )
        stored, size = dataset.id.get_storage_size(), self.path.stat().st_size
        if stored > size or count * dataset.dtype.itemsize > MAX_INFLATION * stored:
            raise self.error(
                "its data are not in the file, or only in part",
                entry,
                expected=f"data for {dataset.shape}",
                found=f"{stored} bytes in a file of {size}",
            )
        self.check_attributes(dataset, {CHECKSUM})
        stored_values = dataset[()]
        self.check_sum(dataset, stored_values)
        return stored_values.astype(dtype, copy=False)

    def check_sum(self, dataset: h5py.Dataset, content: bytes | np.ndarray) -> None:
        """Check the bytes of a dataset against its checksum, where it has one."""
        expected = self.text_attribute(dataset, CHECKSUM)
        if expected is not None and expected != digest(content):
            raise self.error(
                "the data are damaged, or were changed without their checksum",
                str(dataset.name),
                expected=f"sha256 {expected[:12]}...",
                found=f"{digest(content)[:12]}...",
                fix=f"copy or record it again, or delete the attribute {CHECKSUM!r} if the change is meant",
            )

    def dataset(self, group: h5py.Group, name: str) -> h5py.Dataset:
        """Return a dataset whose data lie in this file."""
        dataset = self.entry(group, name, h5py.Dataset)
        entry = f"{group.name}/{name}"
        if dataset.external or dataset.is_virtual:
            raise self.error("its data lie in another file", entry, fix="write them into the recording")
        chunk = math.prod(dataset.chunks or (0,)) * dataset.dtype.itemsize
        if chunk > limits().chunk_bytes:
            raise self.error(
                "its chunks are too large",
                entry,
                expected=f"at most {limits().chunk_bytes} bytes",
                fix=raising("chunk_bytes"),
                found=chunk,
            )
        filters = dataset.id.get_create_plist()
        codes = [filters.get_filter(i)[0] for i in range(filters.get_nfilters())]
        if set(codes) - KNOWN_FILTERS:
            raise self.error("unknown compression", entry, expected="gzip, lzf or none", found=f"filters {codes}")
        return dataset

    def group(self, group: h5py.Group, name: str) -> h5py.Group:
        """Return a group inside a group."""
        return self.entry(group, name, h5py.Group)

    def entry(self, group: h5py.Group, name: str, kind: type[Entry]) -> Entry:
        """Return an entry of a group, without following a link."""
        where = f"{str(group.name).rstrip('/')}/{name}"
        if name not in group.keys():  # noqa: SIM118  `name in group` would follow a link
            raise self.error("an entry is missing", where, expected=f"a {kind.__name__.lower()}")
        if group.id.links.get_info(name.encode()).type != h5l.TYPE_HARD:
            raise self.error("it is a link, and links are not followed", where, fix="copy the data to this place")
        item = group[name]
        if not isinstance(item, kind):
            raise self.error(
                "wrong kind of entry", where, expected=f"a {kind.__name__.lower()}", found=type(item).__name__.lower()
            )
        return item

    def check_attributes(self, item: h5py.Group | h5py.Dataset, known: set[str]) -> None:
        """Refuse an attribute whose name is close to a known one, and note others that are not read."""
        for name in itertools.islice(item.attrs.keys(), limits().channels):
            if name in known or FOREIGN.fullmatch(name):
                continue
            near = difflib.get_close_matches(name.lower(), ALL_ATTRIBUTES, n=1, cutoff=CLOSE_NAME)
            if near:
                place = f"did you mean {near[0]!r}?" if near[0] in known else f"{near[0]!r} belongs to another entry"
                raise self.error("unknown attribute", f"{item.name}, attribute {name[:80]}", fix=place)
            self.unread.append(f"{item.name}, {name[:80]}")

    def warn_unread(self) -> None:
        """Warn of attributes that are not read."""
        if self.unread:
            named = "; ".join(self.unread[:SHOWN_ATTRIBUTES])
            more = f"; and {len(self.unread) - SHOWN_ATTRIBUTES} more" if len(self.unread) > SHOWN_ATTRIBUTES else ""
            warnings.warn(printable(f"{self.path}: attributes that are not read: {named}{more}"), stacklevel=4)

    def refuse_unknown(self, group: h5py.Group, known: set[str], attributes: Collection[str] = ()) -> None:
        """Refuse a group with entries or attributes that would be passed over in silence."""
        self.check_attributes(group, set(attributes))
        unknown = [name for name, _ in zip(group, range(limits().channels), strict=False) if name not in known][:5]
        if unknown:
            raise self.error("unknown entries", group.name, expected=f"only {sorted(known)}", found=unknown)

    def attribute(self, item: h5py.Group | h5py.Dataset, name: str) -> Any:
        """Return a small attribute, or None."""
        if name not in item.attrs:
            return None
        identifier = item.attrs.get_id(name)
        if identifier.get_storage_size() > limits().text_bytes:
            raise self.error("an attribute is too large", f"{item.name}, attribute {name}")
        if h5py.check_string_dtype(identifier.dtype) is None:
            return item.attrs[name]
        return self.bounded(lambda: item.attrs[name], f"{item.name}, attribute {name}")

    def bounded(self, read: Callable[[], Any], entry: str) -> Any:
        """Return what `read` reads, a string whose length is not known before."""
        try:
            with memory_bound(2 * limits().scene_bytes):
                return read()
        except MemoryError:
            raise self.error(
                "the text is too long",
                entry,
                expected=f"at most {limits().scene_bytes} bytes",
                fix=raising("scene_bytes"),
            ) from None

    def text_attribute(self, item: h5py.Group | h5py.Dataset, name: str) -> str | None:
        """Return a text attribute, or None."""
        value = self.attribute(item, name)
        return None if value is None else self.decode(value, f"{item.name}, attribute {name}")

    def decode(self, value: Any, entry: str) -> str:
        """Return text from what h5py gives for a string."""
        if isinstance(value, str):
            value = value.encode("utf-8", "surrogateescape")
        if not isinstance(value, bytes):
            raise self.error("not text", entry, expected="a string", found=type(value).__name__)
        try:
            return value.decode("utf-8")
        except UnicodeDecodeError as error:
            raise self.error("not UTF-8 text", entry, found=error) from None


def digest(content: bytes | np.ndarray) -> str:
    """Return the SHA-256 of the bytes of a text, without trailing zeros, or of an array as it is stored."""
    if isinstance(content, np.ndarray):
        return hashlib.sha256(np.ascontiguousarray(content).tobytes()).hexdigest()
    return hashlib.sha256(content.rstrip(b"\0")).hexdigest()


def sign(dataset: h5py.Dataset) -> None:
    """Give a dataset the attribute with its checksum."""
    encoded = digest(dataset[()]).encode()
    dataset.attrs[CHECKSUM] = np.array(encoded, dtype=h5py.string_dtype("utf-8", len(encoded)))
