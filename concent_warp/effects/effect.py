"""What an effect is: one named piece of physics with parameters, and the hooks by which it changes a model.

An effect acts in up to five places, and says nothing where it does not act:

- `prepare` edits the MJCF once, whatever the parameters' values (it switches something on);
- `edit` edits the MJCF by value, where a compiled model cannot be changed (sizes);
- `write` sets fields of a compiled model;
- `force_model` is a force recomputed before each step;
- `command` and `measure` change what is commanded and what the instruments read.

None of them changes the number of positions, velocities, actuators or sensors that a recording refers to.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Literal

import mujoco
import numpy as np

from concent_warp.errors import ModelError

if TYPE_CHECKING:
    from concent_warp.effects.force_model import ForceModel

Family = Literal["joints", "objects", "contact", "world", "measurement"]
Kind = Literal["joint", "actuator", "body", "geom", "sensor", "none"]
Reader = Callable[[str, np.ndarray], np.ndarray]
"""Given a sensor's name and times [s], shape (T,), returns what the model predicts then, shape (T, dim)."""

OBJECTS = {
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "sensor": mujoco.mjtObj.mjOBJ_SENSOR,
}


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    Example:
        >>> import concent_warp as cw
        >>> model = cw.Model.from_recording(cw.load_recording(cw.example("servo")))
        >>> parameter = cw.effect_class("joint_friction")("hinge").parameters(model.compile())[0]
        >>> parameter.name, parameter.unit, parameter.null
        ('torque[hinge]', 'N m', 0.0)
    """

    name: str
    """Name, with what it belongs to in brackets where there are several: ``torque[joint1]``."""
    unit: str
    """SI unit, "-" where it has none."""
    null: float
    """Value at which the effect does nothing; infinite for a limit."""
    low: float
    """Smallest value that makes sense."""
    high: float
    """Largest."""
    scale: float
    """Typical difference from the null value where the effect is there: the standard deviation of the prior, and the
    unit in which a fit moves."""
    scan: tuple[float, ...] = ()
    """Values worth a trial where nothing is learnt from small changes about the null value."""


class Effect:
    """A physical effect on a selection of joints, actuators, bodies, geoms or sensors of some model.

    Example:
        >>> import concent_warp as cw
        >>> model = cw.Model.from_recording(cw.load_recording(cw.example("servo")))
        >>> effect = cw.effect_class("joint_friction")("hinge")
        >>> [p.name for p in effect.parameters(model.compile())]
        ['torque[hinge]']
    """

    name: ClassVar[str]
    """What users type."""
    family: ClassVar[Family]
    kind: ClassVar[Kind]
    """What a target names."""
    wants: ClassVar[str] = ""
    """What a target must be beyond that, in words; see `suits`."""
    summary: ClassVar[str]
    """What it does, with the formula."""
    source: ClassVar[str]
    """Where the formula is from."""
    signature: ClassVar[str]
    """What it leaves in the residuals of a model that lacks it."""
    confusions: ClassVar[tuple[str, ...]] = ()
    """Effects that leave something alike, by name."""
    rarity: ClassVar[float] = 0.0
    """Twice the logarithm of how much rarer it is than a wrong friction or mass; orders what data cannot tell apart."""
    engines: ClassVar[tuple[str, ...]] = ("mujoco", "warp")
    """Engines that can express it."""
    history: ClassVar[float] = 0.0
    """How far back [s] the commands reach into what acts now."""

    def __init__(self, *target: str) -> None:
        self.target = target

    def __repr__(self) -> str:
        """Return how the effect is made."""
        return f"{type(self).__name__}({', '.join(map(repr, self.target))})"

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the selections to which the effect may apply in a model, each to be tried by itself."""
        raise NotImplementedError

    def suits(self, m: mujoco.MjModel, i: int) -> bool:  # noqa: ARG002
        """Return whether the effect may act on the joint, actuator, body, geom or sensor of an id."""
        return True

    def parameters(self, m: mujoco.MjModel) -> tuple[Parameter, ...]:
        """Return the parameters, P of them; bounds and null values follow from the model without the effect."""
        raise NotImplementedError

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Switch on in the MJCF what the effect needs; it must not change the motion."""

    def edit(self, spec: mujoco.MjSpec, values: np.ndarray) -> None:
        """Edit the MJCF by the values of the parameters, shape (P,)."""

    def write(self, m: mujoco.MjModel, values: np.ndarray) -> None:
        """Set fields of a compiled model by the values of the parameters, shape (P,)."""

    def fields(self, m: mujoco.MjModel) -> tuple[str, ...]:  # noqa: ARG002
        """Return the names of the fields of `mujoco.MjModel` that `write` sets; ``opt.<name>`` for options."""
        return ()

    def force_model(self, m: mujoco.MjModel) -> ForceModel | None:  # noqa: ARG002
        """Return the force that is recomputed before each step; its parameters are those of the effect."""
        return None

    def command(self, m: mujoco.MjModel, ctrl: np.ndarray, values: np.ndarray) -> np.ndarray:  # noqa: ARG002
        """Return what acts where `ctrl`, shape (K, nu), was commanded, one row a time step."""
        return ctrl

    def late(self, m: mujoco.MjModel, values: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:  # noqa: ARG002
        """Return what `command` comes to where it is a delay and a first-order lag, None where it is something else.

        Returns:
            Delays and time constants of all actuators [s], shape (nu,) each.
        """
        return None

    def measure(self, m: mujoco.MjModel, read: Reader, values: np.ndarray) -> Reader:  # noqa: ARG002
        """Return what the instruments read where `read` is what there was to see."""
        return read

    @property
    def edits(self) -> bool:
        """Whether the values enter the MJCF, so that each set of values is compiled by itself."""
        return type(self).edit is not Effect.edit

    @property
    def measures(self) -> bool:
        """Whether the effect changes what the instruments read."""
        return type(self).measure is not Effect.measure

    @property
    def commands(self) -> bool:
        """Whether the effect changes the commands."""
        return type(self).command is not Effect.command

    def check(self, m: mujoco.MjModel) -> None:
        """Check that the targets exist in a model and suit the effect.

        Raises:
            ModelError: One does not, or there is none.
        """
        if self.kind == "none":
            if self.target:
                raise ModelError(f"{self.name} acts on the whole world", expected="no target", found=list(self.target))
            return
        known = _names(m, self.kind)
        if unknown := [name for name in self.target if name not in known]:
            raise ModelError(
                f"{self.name} on what the model lacks", expected=f"{self.kind}s among {known}", found=unknown
            )
        if not self.target:
            raise ModelError(f"{self.name} has no target", expected=f"{self.kind}s among {known}", found="none")
        if unfit := [n for n, i in zip(self.target, self.ids(m), strict=True) if not self.suits(m, int(i))]:
            raise ModelError(f"{self.name} cannot act there", expected=self.wants, found=unfit)

    def ids(self, m: mujoco.MjModel) -> np.ndarray:
        """Return the ids of the targets, shape (n,) int."""
        return np.array([mujoco.mj_name2id(m, OBJECTS[self.kind], name) for name in self.target], dtype=int)

    def each(
        self, name: str, unit: str, null: Sequence[float] | np.ndarray | float, **rest: float
    ) -> tuple[Parameter, ...]:
        """Return one parameter a target; `rest` are the other entries of `Parameter`."""
        values = np.broadcast_to(np.asarray(null, dtype=float), (len(self.target),))
        return tuple(
            Parameter(f"{name}[{t}]", unit, float(v), **rest)  # pyright: ignore[reportArgumentType]
            for t, v in zip(self.target, values, strict=True)
        )


@dataclass(frozen=True)
class AddedEffect:
    """An effect with the values of its parameters: what a model holds."""

    effect: Effect
    values: tuple[float, ...]
    """Values, in the order of `Effect.parameters`."""
    intervals: tuple[tuple[float, float], ...] = ()
    """95 % intervals of the values, where they are known."""

    @cached_property
    def array(self) -> np.ndarray:
        """The values, shape (P,)."""
        return np.asarray(self.values, dtype=float)


def _names(m: mujoco.MjModel, kind: str) -> list[str]:
    """Return the names of a model's joints, actuators, bodies, geoms or sensors."""
    count = {"joint": m.njnt, "actuator": m.nu, "body": m.nbody, "geom": m.ngeom, "sensor": m.nsensor}[kind]
    found = [mujoco.mj_id2name(m, OBJECTS[kind], i) for i in range(count)]
    return [name for name in found if name]


def prepare(spec: mujoco.MjSpec, effects: Sequence[AddedEffect]) -> None:
    """Let effects edit the MJCF that a model is compiled from."""
    for added in effects:
        added.effect.prepare(spec)
    for added in effects:
        added.effect.edit(spec, added.array)


def write(m: mujoco.MjModel, effects: Sequence[AddedEffect]) -> None:
    """Let effects set the fields of a model that was compiled from an MJCF prepared for them, one after the other."""
    for added in effects:
        added.effect.write(m, added.array)


def written(
    m: mujoco.MjModel, effects: Sequence[Effect], values: np.ndarray, split: Sequence[slice]
) -> Mapping[str, np.ndarray]:
    """Return the model fields of N variants in which effects have other values.

    Args:
        m: The model without the values of these effects, prepared for them.
        effects: Effects.
        values: Values of all their parameters, shape (N, P).
        split: Which of the P belong to each effect.

    Returns:
        Each field that any of them sets, shape (N, *field shape).
    """
    import copy

    chosen = sorted({name for effect in effects for name in effect.fields(m)})
    found = {name: np.empty((len(values), *np.shape(_field(m, name)))) for name in chosen}
    for n, row in enumerate(values):
        variant = copy.copy(m)
        for effect, part in zip(effects, split, strict=True):
            effect.write(variant, row[part])
        for name in chosen:
            found[name][n] = _field(variant, name)
    return found


def _field(m: mujoco.MjModel, name: str) -> np.ndarray | float:
    """Return a field of a compiled model, ``opt.<name>`` for an option."""
    return getattr(m.opt, name[4:]) if name.startswith("opt.") else getattr(m, name)
