"""A scene: bodies, joints, actuators and sensors as self-contained MJCF text; `Scene.spec` gives a `mujoco.MjSpec`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import mujoco
import numpy as np

from concent_warp.errors import SceneError
from concent_warp.scene.read_mjcf import compile_spec, readable, spec_from_file, spec_from_text

if TYPE_CHECKING:
    import trimesh

MESHES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf")
"""Kinds of mesh files that a scene may name."""
OBJECTS_TEXT = "concent_objects"
"""Name of the MJCF <text> element that lists the bodies to be given contact geometry."""
GOAL_NUMERIC = "concent_goal"
"""Name of the MJCF <numeric> element with the place of the first object when the task is done, in the frame of the
second [m]."""


@dataclass(frozen=True)
class Scene:
    """Self-contained MJCF text.

    Example:
        >>> import concent_warp as cw
        >>> scene = cw.Scene("<mujoco><worldbody><body><freejoint/><geom size='0.1'/></body></worldbody></mujoco>")
        >>> scene.model.nq
        7
    """

    xml: str
    source: str = "<memory>"
    """File or description of the origin, for messages."""

    @staticmethod
    def from_mjcf(path: Path, *, warn_outside: bool = True) -> Scene:
        """Return the scene of an MJCF file, with includes and meshes written into the text.

        Files that it reads from outside its folder are named in a warning, or refused without `warn_outside`.

        Raises:
            SceneError: The file is missing, MuJoCo cannot compile it, or it asks for more than `Limits` allow.
        """
        if not path.is_file():
            raise SceneError("no such MJCF file", where=path, fix="check the path")
        return _standalone(spec_from_file(path, warn_outside=warn_outside), str(path))

    @staticmethod
    def from_spec(spec: mujoco.MjSpec, source: str = "<memory>") -> Scene:
        """Return the scene of a spec; meshes are written as inline vertices and faces."""
        return _standalone(spec.copy(), source)

    def spec(self) -> mujoco.MjSpec:
        """Return a fresh spec that the caller may edit.

        Bodies and joints without a name are called "body3", "joint2", by their indices: whatever concerns a single one
        of them refers to it by name.
        """
        return _named(spec_from_text(self.xml, self.source))

    def with_timestep(self, timestep: float) -> Scene:
        """Return the scene with another time step [s]."""
        root = ElementTree.fromstring(self.xml)
        option = root.find("option")
        for other in root.findall("option"):
            other.attrib.pop("timestep", None)
        if option is None:
            option = ElementTree.Element("option")
            root.insert(0, option)
        option.set("timestep", repr(float(timestep)))
        return Scene(ElementTree.tostring(root, encoding="unicode"), self.source)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled scene without contact geometry; not to be edited."""
        return compile_spec(self.spec(), self.source)

    def objects(self) -> tuple[str, ...]:
        """Return the names of the bodies that carry contact geometry.

        They are those listed in the MJCF element ``<custom><text name="concent_objects" data="block box"/></custom>``;
        without it, the bodies that have a free joint.
        """
        m = self.model
        text = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_TEXT, OBJECTS_TEXT)
        if text >= 0:
            start = m.text_adr[text]
            names = bytes(m.text_data)[start : start + m.text_size[text]].rstrip(b"\0").decode().split()
            missing = [name for name in names if mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, name) < 0]
            if missing:
                raise SceneError(
                    f"<text name={OBJECTS_TEXT!r}> names bodies that do not exist", where=self.source, found=missing
                )
            if "world" in names:
                raise SceneError(
                    f"<text name={OBJECTS_TEXT!r}> names the world, which carries no contact geometry",
                    where=self.source,
                    expected="bodies that can be touched",
                    found=names,
                    fix="leave the world out",
                )
            return tuple(names)
        free = [j for j in range(m.njnt) if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
        return tuple(m.body(m.jnt_bodyid[j]).name for j in free)

    def goal(self) -> np.ndarray | None:
        """Return where the first object is when the task is done, in the frame of the second [m], shape (3,).

        It is stated in the MJCF element ``<custom><numeric name="concent_goal" data="0 0 0.02"/></custom>``; None
        without it.

        Raises:
            SceneError: The element has not three finite numbers.
        """
        m = self.model
        numeric = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_NUMERIC, GOAL_NUMERIC)
        if numeric < 0:
            return None
        start = m.numeric_adr[numeric]
        found = m.numeric_data[start : start + m.numeric_size[numeric]].copy()
        if found.shape != (3,) or not np.isfinite(found).all():
            raise SceneError(
                f"<numeric name={GOAL_NUMERIC!r}> is no place", where=self.source, expected="x y z in m", found=found
            )
        return found


def _named(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Return a spec, which is changed, with names for all bodies and joints."""
    bodies, joints = list(_tree(spec.worldbody))[1:], []
    for body in bodies:
        joints += list(body.joints)
    for kind, elements, first in (("body", bodies, 1), ("joint", joints, 0)):
        taken = {element.name for element in elements}
        for i, element in enumerate(elements, start=first):
            if not element.name:
                name = f"{kind}{i}"
                while name in taken:
                    name += "_"
                element.name = name
                taken.add(name)
    return spec


def _tree(body: mujoco.MjsBody) -> Iterator[mujoco.MjsBody]:
    """Yield a body and those that hang on it, depth first, as the compiler counts them."""
    waiting = [body]
    while waiting:
        found = waiting.pop()
        yield found
        waiting += reversed(list(found.bodies))


def _standalone(spec: mujoco.MjSpec, source: str) -> Scene:
    """Return the scene of a spec, which is changed.

    A spec read from a file is not copied: the copy silently lacks actuators and sensors that refer to missing names,
    whereas compiling the spec itself raises an error.
    """
    with readable(source):
        for mesh in spec.meshes:
            _inline_mesh(spec, mesh)
    compile_spec(spec, source)
    with readable(source):
        return Scene(spec.to_xml(), source)


def _inline_mesh(spec: mujoco.MjSpec, mesh: mujoco.MjsMesh) -> None:
    """Replace a mesh file by its vertices and faces, so that the scene's text stands alone."""
    if not mesh.file:
        return
    path = Path(spec.modelfiledir) / (spec.meshdir or "") / mesh.file
    if not path.is_file():
        raise SceneError("the scene's mesh file is missing", where=path)
    loaded = _read_mesh(path)
    mesh.uservert = loaded.vertices.astype(float).ravel()
    mesh.userface = loaded.faces.astype(int).ravel()
    mesh.file = ""


def _read_mesh(path: Path) -> trimesh.Trimesh:
    """Return the triangles of a mesh file."""
    import trimesh

    if path.suffix.lower() not in MESHES:
        raise SceneError(
            "a mesh of the scene is of a kind that is not read",
            where=path,
            expected=f"one of {', '.join(MESHES)}",
            found=path.suffix or "no suffix",
            fix="export it as one of them",
        )
    try:
        loaded = trimesh.load(path, force="mesh")
    except Exception as error:  # trimesh's readers raise whatever their parsers do
        found = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise SceneError("a mesh of the scene cannot be read", where=path, found=found) from None
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces) or not np.isfinite(loaded.vertices).all():
        raise SceneError("a mesh of the scene holds no triangles, or vertices that are not finite", where=path)
    return loaded
