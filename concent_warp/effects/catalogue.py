"""Table of effects for the documentation: ``python -m concent_warp.effects.catalogue`` prints it."""

from __future__ import annotations

import re
from typing import get_args

import mujoco

from concent_warp.effects.effect import Effect, Family
from concent_warp.effects.registry import OURS, effect_classes

TITLES = {
    "joints": "Joints and drives",
    "objects": "Objects",
    "contact": "Contact",
    "world": "World",
    "measurement": "Measurement",
}
ACTS_ON = {"none": "the world", "sensor": "sensors", "body": "bodies"} | {
    n: f"{n}s" for n in ("joint", "tendon", "actuator")
}


def sprung_shape_sorter() -> mujoco.MjModel:
    """Return a scene on which every effect of this library can act: the shape sorter, its block on an elastic cord."""
    from concent_warp.scene.shape_sorter import ShapeSorterCfg

    spec = ShapeSorterCfg().build().spec()
    spec.worldbody.add_site(name="hook", pos=[0.0, 0.0, 1.0])
    spec.body("block").add_site(name="eye")
    cord = spec.add_tendon(name="cord", stiffness=[1.0, 0.0, 0.0], springlength=[1.0, 1.0])
    for site in ("hook", "eye"):
        cord.wrap_site(site)
    return spec.compile()


def _catalogue() -> str:
    """Return a Markdown table for each family of this library's effects; units are those on `sprung_shape_sorter`."""
    m = sprung_shape_sorter()
    parts = []
    for family in get_args(Family):
        rows = [_row(effect, m) for effect in OURS if effect.family == family]
        head = "| effect | what it does | parameters | signature | taken for | source |\n|---|---|---|---|---|---|"
        parts.append(f"### {TITLES[family]}\n" + "\n".join([head, *rows]))
    return "\n\n".join(parts) + "\n"


def _row(effect: type[Effect], m: mujoco.MjModel) -> str:
    """Return a row of the table."""
    known = [f"`{name}`" for name in effect.confusions if name in effect_classes()]
    others = [name.replace("_", " ") for name in effect.confusions if name not in effect_classes()]
    cells = [
        f"`{effect.name}` on {ACTS_ON[effect.kind]}",
        effect.summary,
        _parameters(effect, m),
        effect.signature,
        ", ".join([*known, *others]),
        effect.source,
    ]
    if effect.engines != Effect.engines:
        cells[1] += f" Engine: {', '.join(effect.engines)}."
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _parameters(effect: type[Effect], m: mujoco.MjModel) -> str:
    """Return names and units; several parameters of one kind as one, with what they belong to in brackets."""
    units: dict[str, list[str]] = {}
    for target in (*effect.targets(m), *effect.single_targets(m)):
        for parameter in effect(*target).parameters(m):
            found = units.setdefault(re.sub(r"\[.*\]", f"[{effect.kind}]", parameter.name), [])
            if parameter.unit not in found:
                found.append(parameter.unit)
    return ", ".join(f"`{name}`" + _unit(found) for name, found in units.items())


def _unit(found: list[str]) -> str:
    """Return units in words, with what separates them from the name."""
    words = " or ".join("factor" if unit == "-" and len(found) > 1 else unit for unit in found)
    return "" if words == "-" else f" {words}"


if __name__ == "__main__":
    print(_catalogue(), end="")
