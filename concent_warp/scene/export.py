"""Write scene and contact geometry as one MJCF file that plain MuJoCo loads, without this package."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

import mujoco

from concent_warp.errors import ModelError
from concent_warp.scene.contact_geometry import ContactGeometry


class Exportable(Protocol):
    """What an export needs of a model."""

    @property
    def geometry(self) -> ContactGeometry | None:
        """The contact geometry, if any."""

    def spec(self) -> mujoco.MjSpec:
        """Return a fresh spec with the spheres attached."""


def export_mjcf(model: Exportable) -> str:
    """Return self-contained MJCF of a model: its scene and its spheres, by the names of `ContactGeometry.names`.

    It simulates as the model does. Each body with spheres keeps the inertia that the scene gives it, written as an
    explicit ``<inertial>``; the spheres weigh nothing. The numbers of spheres and inertias are written in full; those
    of the scene with six digits, as MuJoCo writes them and as `Scene.from_mjcf` keeps them.
    """
    spec = model.spec()
    spec.compile()
    root = ET.fromstring(spec.to_xml())
    geometry = model.geometry
    if geometry is not None:
        bodies = {element.get("name"): element for element in root.iter("body")}
        for name in geometry.bodies:
            inertial = bodies[name].find("inertial")
            if inertial is None:
                raise ModelError(f"body {name!r} has spheres but no inertia to export")
            write_inertial(inertial, spec.body(name))
        geoms = {element.get("name"): element for element in root.iter("geom") if element.get("name")}
        for i, name in enumerate(geometry.names()):
            geoms[name].set("pos", numbers(geometry.position[i]))
            geoms[name].set("size", numbers([geometry.radius[i]]))
            geoms[name].set("friction", numbers(spec.geom(name).friction))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def save_mjcf(model: Exportable, path: Path) -> None:
    """Write `export_mjcf` to a file, in one piece or not at all."""
    text = export_mjcf(model)
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(text)
    partial.replace(path)


def write_inertial(element: ET.Element, body: mujoco.MjsBody) -> None:
    """Write the inertia of a body in full."""
    element.attrib.clear()
    element.set("pos", numbers(body.ipos))
    element.set("quat", numbers(body.iquat))
    element.set("mass", numbers([body.mass]))
    element.set("diaginertia", numbers(body.inertia))


def numbers(values: Iterable[float]) -> str:
    """Return numbers as text that reads back to the same numbers."""
    return " ".join(repr(float(value)) for value in values)
