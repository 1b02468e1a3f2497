"""Write scene and contact geometry as one MJCF file that plain MuJoCo loads, without this package."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Protocol

import mujoco
import numpy as np

from concent_warp.errors import ModelError
from concent_warp.files import write_text
from concent_warp.scene.scene import Scene
from concent_warp.scene.spheres.contact_geometry import ContactGeometry

FIELDS = (
    "pos", "friction", "condim", "contype", "conaffinity", "priority", "solmix", "solref", "solimp", "margin", "gap",
    "group", "rgba",
)  # fmt: skip
"""Attributes of a sphere that are written out, so that no default class of the scene changes them."""


class Exportable(Protocol):
    """What an export needs of a model."""

    @property
    def scene(self) -> Scene:
        """The scene."""
        ...

    @property
    def geometry(self) -> ContactGeometry | None:
        """The contact geometry, if any."""
        ...

    def compile(self) -> mujoco.MjModel:
        """Return the scene with the spheres, compiled."""
        ...


def _export_mjcf(model: Exportable) -> str:
    """Return self-contained MJCF of a model: the scene's text, with its spheres added.

    It simulates as the model does. The spheres have the names of `ContactGeometry.names` and weigh nothing; each body
    with spheres keeps the inertia that the scene gives it, written as an explicit ``<inertial>``, and its own geoms no
    longer collide. Numbers are written in full.
    """
    geometry = model.geometry
    if geometry is None:
        return model.scene.xml
    root = ET.fromstring(model.scene.xml)
    if not set(geometry.bodies) <= {element.get("name") for element in root.iter("body")}:
        # Bodies made by <attach>, <include> or <replicate> are in the text only once MuJoCo has written it.
        root = ET.fromstring(Scene.from_spec(model.scene.spec(), model.scene.source).xml)
    elements = {element.get("name"): element for element in root.iter("body")}
    compiled = model.compile()
    names = geometry.names()
    for body in geometry.bodies:
        if body not in elements:
            raise ModelError(f"body {body!r} is not in the scene's text", where=model.scene.source)
        element = elements[body]
        for geom in _geoms_of(element):
            geom.set("contype", "0")
            geom.set("conaffinity", "0")
        _write_inertial(element, compiled, body)
        for i in geometry.of(body):
            element.append(_sphere(compiled, names[i]))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def save_mjcf(model: Exportable, path: Path) -> None:
    """Write `_export_mjcf` to a file, in one piece or not at all."""
    write_text(path, _export_mjcf(model))


def _geoms_of(body: ET.Element) -> Iterator[ET.Element]:
    """Yield the geoms of a body and not those of its children."""
    for child in body:
        if child.tag == "geom":
            yield child
        elif child.tag in ("frame", "replicate"):
            yield from _geoms_of(child)


def _write_inertial(element: ET.Element, compiled: mujoco.MjModel, body: str) -> None:
    """Replace the inertia of a body by the compiled one."""
    for old in element.findall("inertial"):
        element.remove(old)
    row = compiled.body(body)
    if row.mass[0] > 0:
        values = {"pos": row.ipos, "quat": row.iquat, "mass": row.mass, "diaginertia": row.inertia}
        element.insert(0, ET.Element("inertial", {name: _numbers(value) for name, value in values.items()}))


def _sphere(compiled: mujoco.MjModel, name: str) -> ET.Element:
    """Return the element of one sphere."""
    geom = compiled.geom(name)
    element = ET.Element("geom", {"name": name, "type": "sphere", "size": _numbers(geom.size[:1]), "mass": "0"})
    for field in FIELDS:
        element.set(field, _numbers(np.atleast_1d(getattr(geom, field))))
    return element


def _numbers(values: Iterable[float]) -> str:
    """Return numbers as text that reads back to the same numbers."""
    return " ".join(str(int(v)) if isinstance(v, np.integer) else repr(float(v)) for v in values)
