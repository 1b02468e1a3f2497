"""Scenes of the BOP benchmark for 6D object pose estimation, as they lie on the disk.

    <data set>/models/obj_000001.ply, models_info.json     meshes [mm], symmetries
    <data set>/test_targets_bop19.json                     images that count in the challenge
    <data set>/test/000048/scene_camera.json               cam_K [px] and depth_scale [mm] of each image
                          /scene_gt.json                   cam_R_m2c, cam_t_m2c [mm] of each object in each image
                          /rgb/000001.png (or gray/)       colours
                          /depth/000001.png                16 bits, in units of depth_scale

The format is that of https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md. A camera looks
along z, with x to the right and y down. Everything that this module returns is in metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from concent_warp.documents import is_number, read_json
from concent_warp.errors import RecordingError
from concent_warp.recording.logs.readers.image_files import SUFFIXES

CAMERA_FILE = "scene_camera.json"
TRUTH_FILE = "scene_gt.json"
TARGETS_FILE = "test_targets_bop19.json"
MODELS_FILE = "models_info.json"
MODELS = ("models", "models_cad", "models_reconst", "models_fine", "models_eval")
"""Folders of meshes in the order of preference."""
COLOUR_FOLDERS, DEPTH_FOLDER = ("rgb", "gray"), "depth"
MILLIMETRE = 1e-3
"""Unit of poses and meshes [m]."""
ROTATION_TOLERANCE = 1e-3
"""Deviation of a rotation from an orthogonal matrix that rounding explains [-]."""


@dataclass(frozen=True)
class BopImage:
    """One RGB-D image."""

    color: Path
    depth: Path
    intrinsics: np.ndarray
    """Pinhole matrix [px], shape (3, 3)."""
    depth_scale: float
    """One unit of the depths [m]."""


@dataclass(frozen=True)
class BopInstance:
    """An object in a scene."""

    object: int
    """Number of its mesh."""
    instance: int = 0
    """Number among objects of the same mesh."""

    @property
    def body(self) -> str:
        """Name of its body: ``obj_000005``, and ``obj_000005_1`` for a second one."""
        return f"obj_{self.object:06d}" + (f"_{self.instance}" if self.instance else "")


@dataclass(frozen=True)
class BopScene:
    """One scene: images of some objects by one camera."""

    folder: Path
    images: Mapping[int, BopImage]
    """By their numbers, ascending."""
    poses: Mapping[int, Mapping[BopInstance, np.ndarray]] = field(default_factory=dict)
    """Object-to-camera transforms, shape (4, 4), by image; empty where the ground truth is withheld."""

    @property
    def number(self) -> int:
        """Number of the scene."""
        return int(self.folder.name)

    @property
    def root(self) -> Path:
        """Folder of the data set."""
        return self.folder.parent.parent

    @property
    def split(self) -> str:
        """Part of the data set, such as ``test``."""
        return self.folder.parent.name

    def instances(self) -> tuple[BopInstance, ...]:
        """Return the objects, from the ground truth, else from the targets of the challenge.

        Raises:
            RecordingError: Nothing tells which objects the scene has.
        """
        found = {one for poses in self.poses.values() for one in poses}
        if not found and (self.root / TARGETS_FILE).is_file():
            for target in read_targets(self.root):
                if target.scene == self.number and target.image in self.images:
                    found |= {BopInstance(target.object, k) for k in range(target.count)}
        if not found:
            raise RecordingError(
                "nothing tells which objects the scene has", where=self.folder,
                expected=f"{TRUTH_FILE}, or its images in {self.root / TARGETS_FILE}",
            )  # fmt: skip
        return tuple(sorted(found, key=lambda one: (one.object, one.instance)))


@dataclass(frozen=True)
class BopTarget:
    """Objects of one kind that the challenge asks for in an image."""

    scene: int
    image: int
    object: int
    count: int


def read_scene(folder: Path) -> BopScene:
    """Return a scene; its images are not decoded.

    Raises:
        RecordingError: It is no scene, or something of it is missing or not of the format.
    """
    folder = Path(folder).absolute()
    path = folder / CAMERA_FILE
    if not path.is_file():
        scenes = sorted(str(one.parent.relative_to(folder)) for one in folder.glob(f"*/*/{CAMERA_FILE}"))
        found = f"a data set with the scenes {', '.join(scenes[:4])}{', ...' * (len(scenes) > 4)}" if scenes else None
        raise RecordingError(
            "not a scene of a BOP data set", where=folder, expected=f"a folder with {CAMERA_FILE}", found=found,
            fix="name one of its scenes" if scenes else None,
        )  # fmt: skip
    if not folder.name.isdigit():
        raise RecordingError("the folder of a scene is not a number", where=folder, expected="such as test/000048")
    colours = next((folder / one for one in COLOUR_FOLDERS if (folder / one).is_dir()), folder / COLOUR_FOLDERS[0])
    by_number = [_files(one) for one in (colours, folder / DEPTH_FOLDER)]
    images = {}
    for number, entry in _by_image(path).items():
        where = f"{path}, image {number}"
        files = [one.get(number) for one in by_number]
        for kind, file in zip((colours.name, DEPTH_FOLDER), files, strict=True):
            if file is None:
                fix = "check that the data set is complete; images without depth cannot be tracked"
                raise RecordingError("an image is missing", where=where, expected=f"{kind}/{number:06d}.png", fix=fix)
        color, depth = files
        assert color is not None
        assert depth is not None
        if not isinstance(entry, dict):
            raise RecordingError("not a camera", where=where, expected="cam_K and depth_scale", found=_short(entry))
        matrix = numbers_of(entry, "cam_K", 9, where).reshape(3, 3)
        if not (min(matrix[0, 0], matrix[1, 1]) > 0 and np.allclose(matrix[2], [0, 0, 1])):
            raise RecordingError(
                "cam_K is no pinhole matrix", where=where, expected="fx 0 cx, 0 fy cy, 0 0 1 in px", found=matrix
            )
        scale = entry.get("depth_scale")
        if not is_number(scale) or scale <= 0:
            raise RecordingError("depth_scale is not right", where=where, expected="mm of one unit", found=repr(scale))
        images[number] = BopImage(color, depth, matrix, float(scale) * MILLIMETRE)
    truth = folder / TRUTH_FILE
    return BopScene(folder, images, _poses(truth, images) if truth.is_file() else {})


def scene_folders(root: Path, split: str) -> list[Path]:
    """Return the folders of the scenes of a part of a data set.

    Raises:
        RecordingError: There is none.
    """
    found = sorted(path.parent for path in (root / split).glob(f"*/{CAMERA_FILE}"))
    if not found:
        known = sorted({path.parent.parent.name for path in root.glob(f"*/*/{CAMERA_FILE}")})
        raise RecordingError(
            "no scenes of a BOP data set", where=root / split, expected=f"folders with {CAMERA_FILE}",
            found=f"scenes in {', '.join(known)}" if known else None,
        )  # fmt: skip
    return found


def models_folder(root: Path, name: str | None) -> Path:
    """Return the folder of the meshes of a data set, the first of `MODELS` where none is named.

    Raises:
        RecordingError: There is none.
    """
    names = MODELS if name is None else (name,)
    folder = next((root / one for one in names if (root / one).is_dir()), None)
    if folder is None:
        raise RecordingError(
            "the data set has no meshes", where=root, expected=f"a folder {' or '.join(names)} with obj_000001.ply",
            fix="download the models of the data set and unpack them beside its images",
        )  # fmt: skip
    return folder


def symmetric_objects(models: Path) -> frozenset[int]:
    """Return the numbers of the objects to which ``models_info.json`` gives a symmetry.

    Raises:
        RecordingError: It cannot be read.
    """
    document = read_json(models / MODELS_FILE, RecordingError)
    if not isinstance(document, dict) or not all(str(k).isdigit() and isinstance(v, dict) for k, v in document.items()):
        raise RecordingError("not the description of meshes", where=models / MODELS_FILE, expected="tables by number")
    kinds = ("symmetries_discrete", "symmetries_continuous")
    return frozenset(int(k) for k, entry in document.items() if any(entry.get(kind) for kind in kinds))


def read_targets(root: Path) -> list[BopTarget]:
    """Return what the challenge asks for in a data set.

    Raises:
        RecordingError: The list is missing, or not of the format.
    """
    path = root / TARGETS_FILE
    document = read_json(path, RecordingError)
    names = ("scene_id", "im_id", "obj_id", "inst_count")
    if not isinstance(document, list):
        raise RecordingError("not a list of targets", where=path, expected=f"entries with {', '.join(names)}")
    found = []
    for k, entry in enumerate(document):
        given = [entry.get(name) for name in names] if isinstance(entry, dict) else []
        values = [value for value in given if isinstance(value, int) and 0 <= value < 10**6]
        if len(values) < len(names):
            raise RecordingError("a target is not right", where=f"{path}, entry {k}", expected=", ".join(names))
        found.append(BopTarget(*values))
    return found


def _files(folder: Path) -> dict[int, Path]:
    """Return the images of a folder by their numbers; empty without the folder."""
    paths = folder.iterdir() if folder.is_dir() else ()
    return {int(path.stem): path for path in paths if path.stem.isdigit() and path.suffix.lower() in SUFFIXES}


def _by_image(path: Path) -> dict[int, Any]:
    """Return the entries of a file by the numbers of images, ascending."""
    document = read_json(path, RecordingError)
    if not isinstance(document, dict) or not document or not all(str(name).isdigit() for name in document):
        raise RecordingError("not a file of a BOP scene", where=path, expected="entries by the numbers of images")
    return dict(sorted((int(name), entry) for name, entry in document.items()))


def _poses(path: Path, images: Mapping[int, BopImage]) -> dict[int, dict[BopInstance, np.ndarray]]:
    """Return the object-to-camera transforms of the ground truth by image and object."""
    found: dict[int, dict[BopInstance, np.ndarray]] = {}
    for number, entries in _by_image(path).items():
        where = f"{path}, image {number}"
        if number not in images:
            raise RecordingError("a pose in an image that is not there", where=where, expected=f"as in {CAMERA_FILE}")
        if not isinstance(entries, list) or not all(isinstance(one, dict) for one in entries):
            raise RecordingError(
                "not poses of objects", where=where, expected="a list of tables", found=_short(entries)
            )
        seen: dict[int, int] = {}
        found[number] = {}
        for entry in entries:
            kind = entry.get("obj_id")
            if not isinstance(kind, int) or not 0 <= kind < 10**6:
                raise RecordingError("obj_id is not right", where=where, expected="a number", found=_short(kind))
            pose = np.eye(4)
            pose[:3, :3] = numbers_of(entry, "cam_R_m2c", 9, where).reshape(3, 3)
            pose[:3, 3] = MILLIMETRE * numbers_of(entry, "cam_t_m2c", 3, where)
            turn = pose[:3, :3]
            if not np.allclose(turn @ turn.T, np.eye(3), atol=ROTATION_TOLERANCE) or np.linalg.det(turn) < 0:
                raise RecordingError("cam_R_m2c is no rotation", where=where, found=turn.round(3).tolist())
            found[number][BopInstance(kind, seen.get(kind, 0))] = pose
            seen[kind] = seen.get(kind, 0) + 1
    return found


def numbers_of(entry: Mapping[str, Any], name: str, count: int, where: str) -> np.ndarray:
    """Return a list of numbers of an entry, shape (count,).

    Raises:
        RecordingError: It is missing, of another length, or holds something else.
    """
    value = entry.get(name)
    if not isinstance(value, list) or len(value) != count or not all(map(is_number, value)):
        raise RecordingError(f"{name} is not right", where=where, expected=f"{count} numbers", found=_short(value))
    return np.array(value, float)


def _short(value: Any) -> str:
    """Return a value in a few characters."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
