"""The state of a tracking on disk, from which an interrupted one continues with the same result.

It is one ``.npz`` without pickles beside the recording that is to be written: the tracks of finished demonstrations,
and of the one in work each tracker's poses, normal equations and keyframes after a moment, and the random state. It
carries a hash of all that the tracks depend on: video, joint readings, scene, first poses, prompts, settings, versions.
"""

from __future__ import annotations

import hashlib
import json
import time
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.array_file import read_arrays, write_arrays
from concent_warp.errors import RecordingError
from concent_warp.perception.tracking.alignment.align import Agreement, Fit
from concent_warp.perception.tracking.alignment.rows import BIASES, Normal
from concent_warp.perception.tracking.alignment.texture import Keyframe
from concent_warp.perception.tracking.body_tracker import BodyTracker
from concent_warp.perception.tracking.result import BodyTrack, TrackQuality
from concent_warp.recording.recording import Recording

PERIOD = 5.0
"""Time between two writings of the state [s]."""
MAX_SHARE = 0.05
"""Share of the time that writing may take [-]; a long video's state is written less often."""
NORMAL = {"information": (6, 6), "gradient": (6,), "bias": (6, BIASES)}
"""Shapes of a set of normal equations."""
TRACKER = ("pose", "tracked", "speed", "time", "searched", "reason", "reasons", "misses", "first_keyframe")
"""Members of a tracker that are its state, besides fits and keyframes."""
SCALARS = ("depth_std", "edge_share", "texture_correlation", "edge_std", "texture_std")
"""Members of a fit that are numbers, in order."""


def state_path(out: Path) -> Path:
    """Return where the state of a tracking that is to write a file is kept."""
    return out.with_name(f".{out.name}.state.npz")


@dataclass
class TrackCheckpoint:
    """The state of a tracking."""

    path: Path
    key: str
    """Hash of all that the tracks depend on."""
    period: float = field(default_factory=lambda: PERIOD)
    """Time between two writings [s]."""
    finished: dict[str, list[BodyTrack]] = field(default_factory=dict)
    """Tracks of finished demonstrations."""
    begun: dict[str, Any] | None = None
    """State of the demonstration in work: name, moments done, random state, and of each tracker."""
    written: float = field(default_factory=time.monotonic)
    """When the state was written last [s]."""
    cost: float = 0.0
    """Time that this took [s]."""

    @staticmethod
    def of(out: Path, key: str, *, resume: bool) -> TrackCheckpoint:
        """Return the state of an interrupted tracking, or a new one where there is none or it is not to be continued.

        Raises:
            RecordingError: It cannot be read, or belongs to something else.
        """
        path = state_path(out)
        if not resume or not path.exists():
            path.unlink(missing_ok=True)
            return TrackCheckpoint(path, key)
        arrays = read_arrays(path, _names(path), kind="the state of a tracking", error=RecordingError)
        try:
            tree = json.loads(str(arrays.pop("tree")))
            found = TrackCheckpoint(path, str(tree["key"]))
            found.finished = {name: _tracks(part, arrays) for name, part in tree["finished"].items()}
            found.begun = None if tree["begun"] is None else _begun(tree["begun"], arrays)
        except (KeyError, TypeError, ValueError, IndexError, AttributeError, RecursionError) as error:
            raise RecordingError(
                "not the state of a tracking", where=path, found=" ".join(str(error).split())[:200],
                fix="delete it to start anew",
            ) from None  # fmt: skip
        if found.key != key:
            raise RecordingError(
                "the interrupted tracking was of another recording, or had other settings or versions",
                where=path,
                fix="repeat the command as it was, or start anew with --overwrite",
            )
        return found

    def begin(self, name: str, trackers: Sequence[BodyTracker], rng: np.random.Generator) -> int:
        """Put trackers and random generator into the state in which a demonstration was left; return the moments that
        are done.
        """
        if self.begun is None or self.begun["name"] != name or not _is_resumable(trackers):
            return 0
        for tracker, state in zip(trackers, self.begun["trackers"], strict=True):
            for member in TRACKER:
                setattr(tracker, member, state[member])
            tracker.fits = list(state["fits"])
            tracker.textures.keyframes[:] = state["keyframes"]
        rng.bit_generator.state = self.begun["random"]
        return int(self.begun["moments"])

    def advance(self, name: str, moments: int, trackers: Sequence[BodyTracker], rng: np.random.Generator) -> None:
        """Write the state after a moment of a demonstration, where the last writing is long enough ago."""
        since = time.monotonic() - self.written
        if since < self.period or since < self.cost / MAX_SHARE or not _is_resumable(trackers):
            return
        states = [
            {member: getattr(t, member) for member in TRACKER} | {"fits": t.fits, "keyframes": t.textures.keyframes}
            for t in trackers
        ]
        self.begun = {"name": name, "moments": moments, "random": rng.bit_generator.state, "trackers": states}
        self._write()

    def finish(self, name: str, tracks: list[BodyTrack]) -> None:
        """Keep the tracks of a finished demonstration."""
        self.finished[name], self.begun = tracks, None
        self._write()

    def remove(self) -> None:
        """Remove the state: the tracking has ended."""
        self.path.unlink(missing_ok=True)

    def _write(self) -> None:
        """Write the state atomically."""
        begun, arrays = time.monotonic(), {}
        tree: dict[str, Any] = {"key": self.key, "begun": None}
        tree["finished"] = {
            name: [_packed_track(track, f"finished/{name}/{k}", arrays) for k, track in enumerate(tracks)]
            for name, tracks in self.finished.items()
        }
        if self.begun is not None:
            states = []
            for k, state in enumerate(self.begun["trackers"]):
                part = _packed({m: state[m] for m in TRACKER}, f"begun/{k}", arrays)
                _pack_fits(state["fits"], f"begun/{k}/fits", arrays)
                part["keyframes"] = [
                    _packed(vars(frame), f"begun/{k}/keyframe/{i}", arrays)
                    for i, frame in enumerate(state["keyframes"])
                ]
                states.append(part)
            tree["begun"] = {m: self.begun[m] for m in ("name", "moments", "random")} | {"trackers": states}
        write_arrays(self.path, {"tree": np.array(json.dumps(tree)), **arrays})
        self.written = time.monotonic()
        self.cost = self.written - begun


def _names(path: Path) -> list[str]:
    """Return the names of the arrays in a file; none where it is no archive."""
    if not zipfile.is_zipfile(path):
        return ["tree"]
    with zipfile.ZipFile(path) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


def _is_resumable(trackers: Sequence[BodyTracker]) -> bool:
    """Return whether the state of trackers is that of the default one; of others only finished demonstrations are
    kept.
    """
    return all(type(tracker) is BodyTracker for tracker in trackers)


def tracking_key(recording: Recording, *rest: object) -> str:
    """Return a hash of the demonstrations of a recording and of other things that tracks depend on."""
    digest = hashlib.blake2b(digest_size=32)
    _add(digest, rest)
    for d in recording.demonstrations:
        _add(digest, [d.name, d.qpos, d.measured, d.action, d.image])
    return digest.hexdigest()


def parts_key(*parts: object) -> list[object]:
    """Return what tells objects from others of their kind, such as a masker: class, settings and files."""
    plain = (str, int, float, bool, Path)
    return [
        [type(part).__name__, {n: v for n, v in vars(part).items() if isinstance(v, plain) or is_dataclass(v)}]
        for part in parts
        if hasattr(part, "__dict__")
    ]


def _add(digest: Any, item: Any) -> None:
    """Add a value to a hash."""
    if isinstance(item, np.ndarray):
        digest.update(f"{item.dtype}{item.shape}".encode())
        digest.update(np.ascontiguousarray(item).data)
    elif is_dataclass(item) and not isinstance(item, type):
        _add(digest, [type(item).__name__, *(getattr(item, f.name) for f in fields(item))])
    elif isinstance(item, Mapping):
        _add(digest, [part for name in sorted(item) for part in (name, item[name])])
    elif isinstance(item, list | tuple):
        digest.update(f"[{len(item)}".encode())
        for part in item:
            _add(digest, part)
    else:
        digest.update(f"{type(item).__name__}:{item!r};".encode())


def _packed(values: Mapping[str, Any], prefix: str, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return plain values; arrays are put into `arrays` under names that begin with a prefix."""
    tree = {}
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            arrays[f"{prefix}/{name}"] = value
            tree[name] = {"array": f"{prefix}/{name}"}
        else:
            tree[name] = value.item() if isinstance(value, np.generic) else value
    return tree


def _unpacked(tree: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the values of `_packed`."""
    return {n: arrays[v["array"]] if isinstance(v, dict) and "array" in v else v for n, v in tree.items()}


def _tracks(parts: list[dict[str, Any]], arrays: Mapping[str, np.ndarray]) -> list[BodyTrack]:
    """Return the tracks of a finished demonstration."""
    found = []
    for part in parts:
        quality = part["quality"]
        if quality is not None:
            quality = _unpacked(quality, arrays)
            for name in ("state", "reason"):
                quality[name] = tuple(quality[name])
            quality = TrackQuality(**quality)
        rest = _unpacked({name: value for name, value in part.items() if name not in ("quality", "cameras")}, arrays)
        found.append(BodyTrack(**rest, quality=quality, cameras=tuple(part["cameras"])))
    return found


def _packed_track(track: BodyTrack, prefix: str, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the plain values of a track, as `_packed`."""
    tree = _packed({name: value for name, value in vars(track).items() if name != "quality"}, prefix, arrays)
    quality = None if track.quality is None else _packed(vars(track.quality), f"{prefix}/quality", arrays)
    return tree | {"quality": quality}


def _begun(tree: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the state of the demonstration in work."""
    states = []
    for k, part in enumerate(tree["trackers"]):
        state = _unpacked({m: part[m] for m in TRACKER}, arrays)
        state["fits"] = _unpacked_fits(f"begun/{k}/fits", arrays)
        state["keyframes"] = [Keyframe(**_unpacked(frame, arrays)) for frame in part["keyframes"]]
        states.append(state)
    return tree | {"trackers": states}


def _pack_fits(fits: Sequence[Fit | None], prefix: str, arrays: dict[str, np.ndarray]) -> None:
    """Put the fits of all moments into arrays, one row each, and the texture's equations of all one after the other."""
    known = [fit for fit in fits if fit is not None]
    texture = [(k, number, normal) for k, fit in enumerate(known) for number, normal in fit.texture]
    arrays[f"{prefix}/found"] = np.array([fit is not None for fit in fits], dtype=bool)
    arrays[f"{prefix}/pose"] = np.array([fit.pose for fit in known]).reshape(-1, 4, 4)
    scalars = [[getattr(fit, name) for name in SCALARS] for fit in known]
    arrays[f"{prefix}/scalars"] = np.array(scalars, float).reshape(-1, len(SCALARS))
    names = [f.name for f in fields(Agreement)]
    agreed = [[np.nan if fit.agreement is None else getattr(fit.agreement, n) for n in names] for fit in known]
    arrays[f"{prefix}/agreement"] = np.array(agreed, float).reshape(-1, len(names))
    arrays[f"{prefix}/texture"] = np.array([row[:2] for row in texture], dtype=np.int64).reshape(-1, 2)
    for part, normals in (("geometry", [f.geometry for f in known]), ("normal", [row[2] for row in texture])):
        for name, shape in NORMAL.items():
            arrays[f"{prefix}/{part}/{name}"] = np.array([getattr(n, name) for n in normals]).reshape(-1, *shape)


def _unpacked_fits(prefix: str, arrays: Mapping[str, np.ndarray]) -> list[Fit | None]:
    """Return the fits of `_pack_fits`."""

    def normal(part: str, row: int) -> Normal:
        return Normal(**{name: arrays[f"{prefix}/{part}/{name}"][row] for name in NORMAL})

    texture: dict[int, list[tuple[int, Normal]]] = {}
    for row, (fit, number) in enumerate(arrays[f"{prefix}/texture"]):
        texture.setdefault(int(fit), []).append((int(number), normal("normal", row)))
    found: list[Fit | None] = []
    k = 0
    for is_known in arrays[f"{prefix}/found"]:
        if not is_known:
            found.append(None)
            continue
        scalars = dict(zip(SCALARS, map(float, arrays[f"{prefix}/scalars"][k]), strict=True))
        row = arrays[f"{prefix}/agreement"][k]
        agreed = None if np.isnan(row[0]) else Agreement(int(row[0]), *map(float, row[1:]))
        found.append(
            Fit(arrays[f"{prefix}/pose"][k], normal("geometry", k), texture.get(k, []), **scalars, agreement=agreed)
        )
        k += 1
    return found
