"""Which effects may be missing from a model, on what."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from concent_warp.effects.effect import Effect
from concent_warp.effects.registry import effect_class, effect_classes
from concent_warp.effects.select import placing_joints
from concent_warp.model import Model


def candidates(
    model: Model, channels: Collection[str], names: Sequence[str] = (), stopped: Collection[str] | None = None
) -> list[Effect]:
    """Return the effects that a model could lack, each on each selection that it may apply to.

    Effects of joints that only place a body (`placing_joints`) are left out unless they are asked for by name.

    Args:
        model: The model; what it has already is left out.
        channels: Sensors that were measured: instruments that recorded nothing lack nothing.
        names: Effects to take; all where empty.
        stopped: Joints that come near a limit: no others show what happens there. All where it is None.

    Raises:
        ModelError: There is no such effect.
    """
    m = model.compile()
    chosen = [effect_class(name) for name in names] if names else list(effect_classes().values())
    placing = {m.joint(j).name for j in placing_joints(m)}
    found: list[Effect] = []
    for kind in chosen:
        for target in (*kind.targets(m), *kind.single_targets(m)):
            if kind.kind == "sensor":
                target = tuple(t for t in target if t in channels)
                if not target:
                    continue
            if kind.kind == "joint" and not names:
                target = tuple(t for t in target if t not in placing)
                if not target:
                    continue
            if kind.at_limits and stopped is not None:
                target = tuple(t for t in target if t in stopped)
                if not target:
                    continue
            effect = kind(*target)
            if not has_effect(model, effect):
                found.append(effect)
    return found


def has_effect(model: Model, effect: Effect) -> bool:
    """Return whether a model has an effect already, on some of its target."""
    return any(
        a.effect.name == effect.name and (not effect.target or set(a.effect.elements) & set(effect.elements))
        for a in model.effects
    )


def is_single_of_many(effect: Effect, among: Sequence[Effect]) -> bool:
    """Return whether an effect acts on one of several elements, and is considered after that on all of them."""
    return effect.singles_last and any(e.name == effect.name and set(effect.target) < set(e.target) for e in among)


def label(effect: Effect, among: Sequence[Effect]) -> str:
    """Return the effect's name, with its target where several candidates share the name, single ones of many aside."""
    same = [e for e in among if e.name == effect.name]
    if len(same) == 1 or not effect.target:
        return effect.name
    if not is_single_of_many(effect, same) and sum(not is_single_of_many(e, same) for e in same) == 1:
        return effect.name
    if len(effect.elements) == 1:
        return f"{effect.name}({', '.join(effect.target)})"
    of = f"{effect.target[0]}, ..."
    return f"{effect.name}({of}, {effect.part})" if effect.part else f"{effect.name}({of})"
