"""Tracks of a BOP scene against its ground truth, and as a result file of the BOP challenge.

The file is that of https://bop.felk.cvut.cz/challenges/bop-challenge-2019/: scene_id,im_id,obj_id,score,R,t,time with R
row by row, t in mm and the time spent on the image in s. Its name is METHOD_DATASET-SPLIT.csv.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from concent_warp.files import write_text
from concent_warp.perception.evaluation.pose_errors import ModelPoints
from concent_warp.perception.tracking.result import BodyTrack
from concent_warp.recording.logs.bop.dataset import MILLIMETRE, models_folder, read_targets
from concent_warp.recording.logs.bop.import_bop import BopImport
from concent_warp.recording.logs.bop.meshes import read_mesh

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
EVALUATION_MODELS = "models_eval"
"""Folder of the meshes whose vertices are compared, where the data set has it."""
NEVER = -1.0
"""Time of a result that was not measured [s]."""


@dataclass(frozen=True)
class BopEstimate:
    """One estimated pose."""

    scene: int
    image: int
    object: int
    pose: np.ndarray
    """Object-to-camera transform [m], shape (4, 4); NaN where the object was lost."""
    truth: np.ndarray | None = None
    """The true one, where known."""
    seconds: float = NEVER
    """Time spent on the image [s]."""


@dataclass(frozen=True)
class BopErrors:
    """Errors of the poses of one object."""

    object: int
    add: np.ndarray
    """ADD of each pose [m], shape (n,); infinite where the object was lost."""
    adds: np.ndarray
    """ADD-S [m], shape (n,)."""


def bop_estimates(
    bop: BopImport, tracks: Sequence[BodyTrack], *, only_targets: bool = False, seconds: float = NEVER
) -> list[BopEstimate]:
    """Return the poses of tracked objects by image.

    Args:
        bop: The scene that was tracked.
        tracks: Tracks of its objects.
        only_targets: Whether only what the challenge asks for is returned (``test_targets_bop19.json``).
        seconds: Time spent on an image [s].

    Raises:
        RecordingError: The list of targets is missing or wrong.
    """
    by_name = {track.body: track for track in tracks}
    wanted = None
    if only_targets:
        wanted = {(one.image, one.object) for one in read_targets(bop.bop.root) if one.scene == bop.bop.number}
    found = []
    for one in bop.instances:
        track = by_name.get(one.body)
        for row, image in enumerate(bop.numbers):
            if wanted is not None and (image, one.object) not in wanted:
                continue
            pose = np.full((4, 4), np.nan) if track is None else track.pose[row]
            truth = bop.bop.poses.get(image, {}).get(one)
            found.append(BopEstimate(bop.bop.number, image, one.object, pose, truth, seconds))
    return found


def bop_errors(estimates: Sequence[BopEstimate], root: Path, models: str | None = None) -> list[BopErrors]:
    """Return the errors of estimates that have a truth, by object.

    Args:
        estimates: The estimates.
        root: Folder of the data set.
        models: Folder of meshes in it; ``models_eval`` by default, where there is one.

    Raises:
        RecordingError: A mesh is missing or cannot be read.
    """
    if models is None and (root / EVALUATION_MODELS).is_dir():
        models = EVALUATION_MODELS
    folder = models_folder(root, models)
    found = []
    for number in sorted({one.object for one in estimates if one.truth is not None}):
        model = ModelPoints(np.asarray(read_mesh(folder, number).vertices, float))
        pairs = [(one.pose, one.truth) for one in estimates if one.object == number and one.truth is not None]
        add = np.array([model.add(*pair) for pair in pairs])
        found.append(BopErrors(number, add, np.array([model.adds(*pair) for pair in pairs])))
    return found


def write_results(path: Path, estimates: Sequence[BopEstimate]) -> int:
    """Write a result file of the BOP challenge, with a score of 1 for each pose; return how many poses it has.

    Poses of lost objects are left out.

    Raises:
        OSError: The file cannot be written.
    """
    kept = [one for one in estimates if np.isfinite(one.pose).all()]
    lines = [HEADER]
    for one in sorted(kept, key=lambda one: (one.scene, one.image, one.object)):
        turn = " ".join(repr(float(v)) for v in one.pose[:3, :3].ravel())
        shift = " ".join(repr(float(v)) for v in one.pose[:3, 3] / MILLIMETRE)
        lines.append(f"{one.scene},{one.image},{one.object},1,{turn},{shift},{one.seconds:.6g}")
    write_text(path, "\n".join(lines) + "\n")
    return len(kept)
