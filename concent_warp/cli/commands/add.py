"""``concent add``: a model gets one more physical effect, at given values or fitted to a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from rich.markup import escape

from concent_warp.checks import WindowLength
from concent_warp.cli.fitted_effects import say_added, say_fitted, work_progress
from concent_warp.cli.given_recording import given_recording
from concent_warp.cli.options import EngineOption, NoiseOption, OptionalOutPath
from concent_warp.cli.terminal import say, say_written
from concent_warp.effects.registry import effect_classes
from concent_warp.errors import ConcentError
from concent_warp.model import Model
from concent_warp.run_folder import claim_file, make_folder

if TYPE_CHECKING:
    from concent_warp.effects.effect import Parameter
    from concent_warp.fit.effects.fit import FittedEffects


@dataclass(frozen=True)
class Arguments:
    """Add a physical effect to a model: at its null value, at given values, or fitted to a recording together with the
    effects that the model has.
    """

    effect: tyro.conf.Positional[str] = ""
    """Effect; --list shows all. With --fit it may be left out: the effects that the model has are fitted again."""
    list: bool = False
    """List all effects with their parameters, and with --model where in it each may act."""
    model: Path | None = None
    """Model (.toml) or MJCF (.xml)."""
    target: tuple[str, ...] = ()
    """Joints, tendons, actuators, bodies or sensors that it acts on; by default all that it may act on."""
    set: tuple[str, ...] = ()
    """Values of parameters, such as torque[joint1]=0.1; with --fit the values to start from."""
    fit: Path | None = None
    """Recording to fit it to."""
    demonstrations: tuple[str, ...] = ()
    """Demonstrations of it; all by default."""
    noise: NoiseOption = ()
    window: WindowLength | None = None
    """Length of the windows that are simulated in one go [s]; by default as long as the motion allows."""
    engine: EngineOption = "mujoco"
    out: OptionalOutPath = None
    """Model file (.toml) to write."""
    overwrite: bool = False
    """Replace it if it is there."""


def run(arguments: Arguments) -> FittedEffects | Model | None:
    """Add, fit, save; or list."""
    if arguments.list:
        _say_effects(None if arguments.model is None else Model.load(arguments.model))
        return None
    effect_or_fit = arguments.effect or arguments.fit
    for given, option in ((effect_or_fit, "EFFECT"), (arguments.model, "--model"), (arguments.out, "--out")):
        if not given:
            raise ConcentError(f"{option} is missing", fix="see concent add --help, or --list for all effects")
    assert arguments.model is not None
    assert arguments.out is not None
    model = Model.load(arguments.model)
    _check_out(arguments.out, arguments.overwrite)
    if arguments.effect:
        added = model.add_effect(arguments.effect, arguments.target, _assigned(arguments.set))
    elif arguments.target or arguments.set:
        raise ConcentError("--target and --set are of an effect that is added", fix="name the effect")
    else:
        added = model
    fitted = None
    if arguments.fit is not None:
        from concent_warp.fit.effects.fit import FitEffectsCfg, fit_effects

        recording = given_recording(arguments.fit, arguments.demonstrations, arguments.noise)
        model.check_recording(recording)
        with work_progress("fitting") as progress:
            cfg = FitEffectsCfg(window=arguments.window)
            fitted = fit_effects(added, recording, cfg, engine=arguments.engine, progress=progress)
        added = fitted.model
    make_folder(arguments.out.parent)
    added.save(arguments.out)
    if fitted is not None:
        say_fitted(fitted)
    else:
        new = added.effects[len(model.effects) :]
        say_added(new, [[p.name for p in a.effect.parameters(model.compile())] for a in new])
    say_written(arguments.out)
    return fitted or added


def _check_out(path: Path, overwrite: bool) -> None:
    """Check that a model can be written there.

    Raises:
        ConcentError: The name does not end in .toml, or the file exists.
    """
    if path.suffix != ".toml":
        raise ConcentError("the name of a model file ends in .toml", where=path)
    claim_file(path, overwrite=overwrite)


def _assigned(given: Sequence[str]) -> dict[str, float]:
    """Return parameters' values from ``name=value``.

    Raises:
        ConcentError: Something is not of that form.
    """
    found = {}
    for text in given:
        name, _, value = text.rpartition("=")
        try:
            found[name.strip()] = float(value)
        except ValueError:
            name = ""
        if not name:
            raise ConcentError("--set is not right", expected="name=value with a number", found=text)
    return found


def _say_effects(model: Model | None) -> None:
    """Write a table of all effects; with a model, where in it each may act."""
    from rich.table import Table

    from concent_warp.scene.shape_sorter import ShapeSorterCfg

    m = (Model(ShapeSorterCfg().build()) if model is None else model).compile()
    table = Table(header_style="bold", show_lines=False)
    columns = ["effect", "what it does", "parameters [unit]", *(["may act on"] if model is not None else [])]
    for name in columns:
        table.add_column(name, no_wrap=name == "effect")
    family = ""
    for kind in effect_classes().values():
        if family and kind.family != family:
            table.add_section()
        family = kind.family
        selections = kind.targets(m)
        cells = [kind.name, kind.summary, _parameters_text([p for s in selections for p in kind(*s).parameters(m)])]
        if model is not None:
            cells.append("; ".join(", ".join(s) or "the world" for s in selections) or "nothing here")
        table.add_row(*map(escape, cells))
    say(table)


def _parameters_text(parameters: Sequence[Parameter]) -> str:
    """Return names and units of parameters; several of a kind as one."""
    found: dict[str, list[str]] = {}
    for p in parameters:
        units = found.setdefault(p.name.split("[")[0], [])
        if p.unit not in units:
            units.append(p.unit)
    return ", ".join(f"{name} [{' or '.join(units)}]" for name, units in found.items())
