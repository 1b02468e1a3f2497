"""Numbers, texts and images of a LeRobot v3 data set, as a flow policy learns from them.

Features are found by the data set's own description, ``meta/info.json``. Numbers of all frames are in memory; `frames`
decodes the images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.errors import TrainError
from concent_warp.recording.logs.readers.lerobot import BOOKKEEPING, NUMBERS, SUCCESS, LeRobotLog
from concent_warp.recording.logs.readers.log import Episode
from concent_warp.train.flow.cfg import FlowDataCfg
from concent_warp.train.flow.sources import EpisodeSources, open_dataset

IMAGES = "observation.images."
"""Begins the names of features of images."""
STATE, ACTION = "observation.state", "action"
OBSERVATION, ACTIONS = "observation.", "action."
LABELS = "teacher_chunk"
"""Feature with the commands that a teacher would give from a frame on; NaN where it is the one that drives."""


def label_names(action: Sequence[str], length: int) -> tuple[str, ...]:
    """Return the names of the numbers of a label: those of the actions, each with its step."""
    return tuple(f"{step}:{name}" for step in range(length) for name in action)


@dataclass(frozen=True)
class FlowFeatures:
    """Inputs and outputs of a flow policy, by the names of a data set."""

    cameras: tuple[str, ...]
    """Cameras, without "observation.images."."""
    state: tuple[str, ...]
    """Names of the proprioception's numbers."""
    action: tuple[str, ...]
    """Names of an action's numbers."""
    rate: float
    """Actions in a second [Hz]."""
    tasks: tuple[str, ...]
    """Instructions of the data set."""
    size: tuple[int, int]
    """Height and width of the images of the first camera in the data set [px]."""

    def plain(self) -> dict[str, Any]:
        """Return the features as plain data."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    @staticmethod
    def of(plain: Mapping[str, Any]) -> FlowFeatures:
        """Return the features that `plain` returned."""
        names = {name: tuple(map(str, plain[name])) for name in ("cameras", "state", "action", "tasks")}
        height, width = map(int, plain["size"])
        return FlowFeatures(rate=float(plain["rate"]), size=(height, width), **names)


@dataclass(frozen=True)
class FlowDataset:
    """A data set of T frames in E episodes."""

    features: FlowFeatures
    state: np.ndarray
    """Proprioception, shape (T, P) float32."""
    action: np.ndarray
    """Actions, shape (T, A) float32."""
    task: np.ndarray
    """Instruction of each frame, a row of `features.tasks`, shape (T,) int64."""
    start: np.ndarray
    """First frame of each episode, shape (E + 1,) int64, the last entry being T."""
    images: tuple[str, ...]
    """Features of the images, in the order of the cameras."""
    labels: np.ndarray | None = None
    """Chunks of a teacher from each frame on, shape (T, C, A) float32, NaN where the frames themselves go on as it
    would; None where the data set has none."""

    @property
    def lengths(self) -> list[int]:
        """Frames of each episode."""
        return np.diff(self.start).tolist()

    def last(self) -> np.ndarray:
        """Return the last frame of the episode of each frame, shape (T,) int64."""
        return np.repeat(self.start[1:] - 1, np.diff(self.start))

    def split(self, share: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the frames of training and of validation, each (n,) int64, whole episodes apart.

        Args:
            share: Share of the episodes for validation; at least one is, where it is above 0 and there are two.
            seed: Of the choice.
        """
        count = len(self.start) - 1
        held = 0 if share == 0 or count < 2 else min(max(1, round(share * count)), count - 1)
        order = np.random.default_rng(seed).permutation(count)
        parts = (np.sort(order[held:]), np.sort(order[:held]))
        rows = [np.arange(self.start[k], self.start[k + 1]) for k in range(count)]
        training, validation = ([rows[k] for k in part] for part in parts)
        return np.concatenate(training), np.concatenate(validation or [np.zeros(0, dtype=np.int64)])


def read_dataset(log: EpisodeSources, cfg: FlowDataCfg) -> FlowDataset:
    """Return numbers and texts of data sets.

    Args:
        log: The data sets.
        cfg: Which features.

    Raises:
        TrainError: They lack features or have no episodes, or a number is not finite.
        RecordingError: A table is missing or cannot be read.
    """
    chosen = _chosen_of_all(log, cfg)
    if not log.numbers:
        raise TrainError("the data set has no episodes", where=log.source)
    tables, tasks, lengths, labels = [], [], [], []
    names: tuple[tuple[str, ...], tuple[str, ...]] | None = None
    size = (0, 0)
    for number in log.numbers:
        episode, where = log.episode(number), log.where(number)
        found = tuple(_columns(episode, features, where) for features in (chosen.state, chosen.action))
        now = (tuple(found[0]), tuple(found[1]))
        if names not in (None, now):
            raise TrainError("an episode has other columns", where=where, expected=names, found=now)
        names, size = now, episode.images[chosen.cameras[0]].size
        tables.append([_table(columns, where) for columns in found])
        tasks.append(episode.task)
        lengths.append(len(tables[-1][1]))
        if cfg.labels and LABELS in log.features(number):
            labels.append(_labels(episode, chosen.action, now[1], where))
        else:
            labels.append(None)
    assert names is not None
    texts = tuple(dict.fromkeys(tasks))
    cameras = tuple(name.removeprefix(IMAGES) for name in chosen.cameras)
    return FlowDataset(
        FlowFeatures(cameras, *names, log.rate, texts, size),
        np.concatenate([state for state, _ in tables]),
        np.concatenate([action for _, action in tables]),
        np.repeat([texts.index(task) for task in tasks], lengths),
        np.concatenate([[0], np.cumsum(lengths)]),
        chosen.cameras,
        _joined_labels(labels, lengths, len(names[1])),
    )


def check_features(sources: Sequence[Path], cfg: FlowDataCfg) -> None:
    """Check that folders hold data sets with the chosen features, before anything is decoded.

    Raises:
        TrainError: One lacks features, or they do not fit one another.
        RecordingError: One is no LeRobot v3 data set.
    """
    _chosen_of_all(open_dataset(*sources), cfg)


def _chosen_of_all(log: EpisodeSources, cfg: FlowDataCfg) -> FlowDataCfg:
    """Return the names of the features that are chosen; what is found in the first data set is expected of all.

    Raises:
        TrainError: One of the data sets lacks features.
    """
    chosen = _chosen_features(log.logs[0], cfg)
    for other in log.logs[1:]:
        _chosen_features(other, chosen)
    return chosen


def _chosen_features(log: LeRobotLog, cfg: FlowDataCfg) -> FlowDataCfg:
    """Return the names of the features that are chosen, or that are taken where none are.

    Raises:
        TrainError: There are no such features.
    """
    where = log.source / "meta" / "info.json"
    colours = [name for name, f in log.features.items() if f["dtype"] in ("video", "image") and not _is_depth(f)]
    numeric = [
        name
        for name, f in log.features.items()
        if f["dtype"].startswith(NUMBERS) and name not in BOOKKEEPING and name != SUCCESS
    ]
    cameras = [next((n for n in (one, IMAGES + one) if n in colours), one) for one in cfg.cameras] or colours
    state = cfg.state or ([STATE] if STATE in numeric else [n for n in numeric if n.startswith(OBSERVATION)])
    action = cfg.action or ([ACTION] if ACTION in numeric else [n for n in numeric if n.startswith(ACTIONS)])
    for what, option, names, known in (
        ("images", "cameras", cameras, colours), ("proprioception", "state", state, numeric),
        ("actions", "action", action, numeric),
    ):  # fmt: skip
        if not names:
            raise TrainError(f"the data set has no feature of {what}", where=where, found=sorted(log.features))
        if missing := [name for name in names if name not in known]:
            found = f"{missing[0]!r} among --{option}"
            raise TrainError(f"the data set has no such feature of {what}", where=where, expected=known, found=found)
        if len(set(names)) < len(names):
            raise TrainError(f"a feature of {what} is named twice", where=where, found=list(names))
    return FlowDataCfg(tuple(cameras), tuple(state), tuple(action), labels=cfg.labels)


def _is_depth(feature: Mapping[str, Any]) -> bool:
    """Return whether a feature of images is one of depths."""
    info = {**(feature.get("video_info") or {}), **(feature.get("info") or {})}
    return bool(info.get("is_depth_map") or info.get("video.is_depth_map"))


def _columns(episode: Episode, features: Sequence[str], where: str) -> dict[str, np.ndarray]:
    """Return the columns (T,) of features by name.

    Raises:
        TrainError: The table lacks a feature.
    """
    found: dict[str, np.ndarray] = {}
    for feature in features:
        columns = {n: s.value for n, s in episode.signals.items() if n == feature or n.startswith(f"{feature}/")}
        if not columns:
            raise TrainError("the table lacks a feature", where=where, expected=feature, found=sorted(episode.signals))
        # The names of the most common features are dropped: "observation.state/elbow" is "elbow".
        plain = feature in (STATE, ACTION) and len(features) == 1
        found |= {name.removeprefix(f"{feature}/") if plain else name: value for name, value in columns.items()}
    return found


def _table(columns: Mapping[str, np.ndarray], where: str) -> np.ndarray:
    """Return columns as a table (T, n) float32.

    Raises:
        TrainError: A number is not finite.
    """
    for name, value in columns.items():
        if not np.isfinite(value).all():
            row = int(np.flatnonzero(~np.isfinite(value))[0])
            fix = "mend the data set, or choose other features"
            raise TrainError(f"{name} is not finite", where=f"{where}, frame {row}", found=value[row], fix=fix)
    return np.stack(list(columns.values()), axis=1).astype(np.float32)


def _labels(episode: Episode, features: Sequence[str], action: Sequence[str], where: str) -> np.ndarray:
    """Return the labels of the frames of an episode, shape (T, C, A) float32; see `FlowDataset.labels`.

    Args:
        episode: The episode.
        features: Chosen features of actions.
        action: Names of the action's numbers.
        where: The episode's place, for messages.

    Raises:
        TrainError: They are of other actions, or a label is finite in part.
    """
    if tuple(features) != (ACTION,):
        fix = "choose no other actions, or set labels aside with --data.no-labels"
        raise TrainError(f"{LABELS} labels other actions", where=where, expected=ACTION, found=list(features), fix=fix)
    columns = {n.partition("/")[2]: s.value for n, s in episode.signals.items() if n.startswith(f"{LABELS}/")}
    expected = label_names(action, len(columns) // len(action))
    if not expected or tuple(columns) != expected:
        raise TrainError(f"{LABELS} is of other actions", where=where, expected=expected[:3], found=list(columns)[:3])
    found = np.stack(list(columns.values()), axis=1).astype(np.float32)
    known = np.isfinite(found)
    if (broken := known.any(axis=1) & ~known.all(axis=1)).any():
        row = int(np.flatnonzero(broken)[0])
        fix = "mend the data set, or set labels aside with --data.no-labels"
        raise TrainError(f"{LABELS} is not finite in part", where=f"{where}, frame {row}", fix=fix)
    return found.reshape(len(found), -1, len(action))


def _joined_labels(parts: Sequence[np.ndarray | None], lengths: Sequence[int], width: int) -> np.ndarray | None:
    """Return the labels of all episodes, as long as the shortest ones; None without any.

    Args:
        parts: Labels of each episode, (T, C, A), None where it has none.
        lengths: Frames of each episode.
        width: Numbers A of an action.
    """
    length = min((part.shape[1] for part in parts if part is not None), default=0)
    if not length:
        return None
    unknown = (np.full((count, length, width), np.nan, dtype=np.float32) for count in lengths)
    return np.concatenate([u if part is None else part[:, :length] for u, part in zip(unknown, parts, strict=True)])
