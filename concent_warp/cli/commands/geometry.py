"""``concent geometry``: a scene becomes a model with contact spheres; a model becomes MJCF."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from concent_warp.checks import Positive
from concent_warp.cli.options import OptionalOutPath
from concent_warp.cli.terminal import say, say_written
from concent_warp.errors import SceneError
from concent_warp.files import all_or_none
from concent_warp.model import Model, model_with_spheres
from concent_warp.run_folder import claim_file, make_folder
from concent_warp.scene.spheres.build import ContactGeometryCfg
from concent_warp.scene.spheres.export import save_mjcf


@dataclass(frozen=True)
class Arguments:
    """Lay contact spheres on the objects of a scene and save the model, or export a model as plain MJCF."""

    scene: tyro.conf.Positional[Path]
    """MJCF scene (.xml), recording (.h5), or model.toml whose geometry is kept."""
    out: OptionalOutPath = None
    """Model file to write (.toml); the scene and the spheres go beside it."""
    export: Path | None = None
    """MJCF to write (.xml), with the spheres, for plain MuJoCo."""
    objects: tuple[str, ...] = ()
    """Bodies to lay spheres on; by default those that the scene names, else those with a free joint."""
    add: Mapping[str, Path] = field(default_factory=dict)
    """Objects to add to the scene first, as name and file: a mesh, a point cloud or Gaussian splats."""
    scale: Positive = 1.0
    """Factor from the unit of these files to metres."""
    overwrite: bool = False
    """Replace files that are there."""
    geometry: Annotated[ContactGeometryCfg, tyro.conf.OmitArgPrefixes] = field(default_factory=ContactGeometryCfg)


def run(arguments: Arguments) -> Model:
    """Build or read the model, and write what was asked for."""
    if arguments.out is None and arguments.export is None:
        raise SceneError("nothing to write", fix="pass --out model.toml, --export model.xml, or both")
    for path in (arguments.out, arguments.export):
        if path is not None:
            claim_file(path, overwrite=arguments.overwrite)
    model = model_with_spheres(
        arguments.scene, arguments.geometry, objects=arguments.objects, added=arguments.add, scale=arguments.scale
    )
    with all_or_none():
        if arguments.out is not None:
            make_folder(arguments.out.parent)
            model.save(arguments.out)
        if arguments.export is not None:
            make_folder(arguments.export.parent)
            save_mjcf(model, arguments.export)
    for path in (arguments.out, arguments.export):
        if path is not None:
            say_written(path)
    if (geometry := model.geometry) is None:
        return model
    for body in geometry.bodies:
        rows = geometry.of(body)
        radius = geometry.radius[rows] * 1e3
        say(f"{body}: {len(rows)} spheres, radius {radius.min():.1f} to {radius.max():.1f} mm")
    return model
