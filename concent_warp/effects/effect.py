"""Base class of physical effects: one named effect with parameters, and the methods by which it changes a model.

An effect implements those of these methods that it needs:

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

from concent_warp.effects.posterior import JointPosterior
from concent_warp.errors import ModelError

if TYPE_CHECKING:
    from concent_warp.effects.force_model import ForceModel

Family = Literal["joints", "objects", "contact", "world", "measurement"]
Kind = Literal["joint", "tendon", "actuator", "body", "geom", "sensor", "none"]
Variable = Literal["joint velocity"]
Reader = Callable[[str, np.ndarray], np.ndarray]
"""Given a sensor's name and times [s], shape (T,), returns what the model predicts then, shape (T, dim)."""

OBJECTS = {
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "sensor": mujoco.mjtObj.mjOBJ_SENSOR,
}


PHASE_ERROR = 0.25
"""Standard deviation of a delay due to the model's time step, over the step [-]: a semi-implicit step answers a force
at its end as if it had acted from its beginning, half a step early, which is the 95 % interval."""


def with_unit(text: str, unit: str) -> str:
    """Return a number in words with its unit after it, which may be "-" for none."""
    return text if unit == "-" else f"{text} {unit}"


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
    """Lower bound."""
    high: float
    """Upper bound."""
    scale: float
    """Typical difference from the null value: the standard deviation of the prior, and the unit of a fit's steps."""
    scan: tuple[float, ...] = ()
    """Values to try where the sensitivity at the null value is zero or misleading, as for effects with a threshold."""
    scan_together: tuple[tuple[tuple[float, ...], ...], ...] = ()
    """Lines of values to try, each from the null value outward, of it and the parameters after it: where a change of
    one alone misleads."""
    typical: float = 0.0
    """The same in the odds between effects that explain as much, where it is more than `scale`: what experience expects
    may be more than a step over which motion is linear."""
    is_side: bool = False
    """Whether it is no size of the effect but a choice within its formula: its bounds say nothing of what is left."""


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
    """Name in the command line, model files and reports."""
    family: ClassVar[Family]
    kind: ClassVar[Kind]
    """Kind of element that a target names."""
    requirement: ClassVar[str] = ""
    """Requirement on a target besides its kind, as text for messages; see `applies_to`."""
    summary: ClassVar[str]
    """What it does, with the formula."""
    source: ClassVar[str]
    """Where the formula is from."""
    signature: ClassVar[str]
    """Typical residuals of a model that lacks it."""
    confusions: ClassVar[tuple[str, ...]] = ()
    """Names of effects with similar residuals."""
    rarity: ClassVar[float] = 0.0
    """Twice the logarithm of how much rarer it is than a wrong friction or mass; orders effects that the data do
    not distinguish."""
    parts: ClassVar[tuple[str, ...]] = ()
    """Parts of an element that a target may name after it; each is a candidate by itself."""
    special_cases: ClassVar[tuple[str, ...]] = ()
    """Names of effects of fewer parameters that it equals at some of its values; it is not named beside one of them
    that explains as much."""
    variables: ClassVar[tuple[Variable, ...]] = ()
    """What its formula is a function of, where a force of no known form in the same variable corrects it."""
    formula_error: ClassVar[float] = 0.0
    """Standard deviation of the effect's size between repeated measurements, relative to it [-]: by how much what the
    formula leaves out (wear, temperature, place) changes its parameters. Part of their intervals."""
    null_error: ClassVar[float] = 0.0
    """Standard deviation of the null values relative to them [-]: by how much the model's own values of the quantity
    are uncertain, where it is no constant of the bodies. Part of the intervals."""
    step_error: ClassVar[float] = 0.0
    """Standard deviation of its values due to the model's time step, over the step [-]. Part of the intervals."""
    exact: ClassVar[bool] = False
    """Whether its formula leaves nothing out, so that its values are the same in all windows of a recording."""
    part_of: ClassVar[str] = ""
    """Name of the effect that is the same quantity without a tolerance, for a nominal value; see `is_within`."""
    engines: ClassVar[tuple[str, ...]] = ("mujoco", "warp")
    """Engines that can express it."""
    nominal: ClassVar[bool] = False
    """Whether it stands for a nominal value of the model within its tolerance, which no diagnosis calls missing."""
    singles_last: ClassVar[bool] = False
    """Whether a diagnosis considers `single_targets` only where no other candidate explains the data."""
    at_limits: ClassVar[bool] = False
    """Whether it acts at the limits of joints alone: on joints that come near one."""
    history: ClassVar[float] = 0.0
    """Length [s] of the history of commands on which the present command depends."""

    def __init__(self, *target: str) -> None:
        self.target = target

    def __repr__(self) -> str:
        """Return the constructor call of the effect."""
        return f"{type(self).__name__}({', '.join(map(repr, self.target))})"

    @classmethod
    def targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:
        """Return the selections to which the effect may apply in a model; each is a separate candidate."""
        raise NotImplementedError

    @classmethod
    def single_targets(cls, m: mujoco.MjModel) -> tuple[tuple[str, ...], ...]:  # noqa: ARG003
        """Return further selections that are candidates of their own beside `targets`: single elements, or parts.

        None by default. An effect that has one value for all elements of a selection may act on one of them alone.
        """
        return ()

    def applies_to(self, m: mujoco.MjModel, i: int) -> bool:  # noqa: ARG002
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
        """Return the commands that act for the given ones `ctrl`, shape (K, nu) each, one row a time step."""
        return ctrl

    def delay_and_lag(self, m: mujoco.MjModel, values: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:  # noqa: ARG002
        """Return `command` as a delay and a first-order lag, or None where it has another form.

        Returns:
            Delays and time constants of all actuators [s], shape (nu,) each.
        """
        return None

    def measure(self, m: mujoco.MjModel, read: Reader, values: np.ndarray) -> Reader:  # noqa: ARG002
        """Return the reader of the instruments; `read` gives the true values."""
        return read

    def true_time(self, time: float, values: np.ndarray) -> float:  # noqa: ARG002
        """Return the true time [s] of what the target's sensors stamp with `time` [s]."""
        return time

    def true_state(
        self,
        m: mujoco.MjModel,  # noqa: ARG002
        qpos: np.ndarray,
        qvel: np.ndarray,
        values: np.ndarray,  # noqa: ARG002
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the true state of which the instruments show `qpos` (nq,) and `qvel` (nv,), apart from `true_time`."""
        return qpos, qvel

    @classmethod
    def is_within(cls, other: Effect) -> bool:
        """Return whether another effect is the same quantity without a tolerance, for a nominal value."""
        return bool(cls.part_of) and other.name == cls.part_of

    def has_as_special_case(self, other: Effect) -> bool:
        """Return whether another effect of fewer parameters equals this one at some of its values."""
        return other.name in self.special_cases

    @property
    def part(self) -> str:
        """The part of the elements that the target names, one of `parts`; empty where it names none."""
        return self.target[-1] if len(self.target) > 1 and self.target[-1] in self.parts else ""

    @property
    def elements(self) -> tuple[str, ...]:
        """Names of the joints, actuators, bodies, geoms or sensors among the target."""
        return self.target[:-1] if self.part else self.target

    @property
    def is_part(self) -> bool:
        """Whether its target names a part of the elements.

        A diagnosis considers parts only where no other candidate explains the data: there are many of them.
        """
        return bool(self.part)

    @property
    def is_alone(self) -> bool:
        """Whether it is named only where it explains the data without others: else it may imitate several of them."""
        return False

    @property
    def edits(self) -> bool:
        """Whether the values enter the MJCF, so that each set of values is compiled by itself."""
        return type(self).edit is not Effect.edit

    @property
    def prepares(self) -> bool:
        """Whether the model differs by more than the values of its fields as soon as it has the effect."""
        return type(self).prepare is not Effect.prepare or self.edits

    @property
    def measures(self) -> bool:
        """Whether the effect changes what the instruments read."""
        return type(self).measure is not Effect.measure

    @property
    def misleads_start(self) -> bool:
        """Whether a state that the instruments show is not the true one."""
        kind = type(self)
        return kind.true_time is not Effect.true_time or kind.true_state is not Effect.true_state

    @property
    def commands(self) -> bool:
        """Whether the effect changes the commands."""
        return type(self).command is not Effect.command

    def check(self, m: mujoco.MjModel) -> None:
        """Check that the targets exist in a model and that the effect can act on them.

        Raises:
            ModelError: A target does not exist or does not meet the requirement, or there is no target.
        """
        if self.kind == "none":
            if self.target:
                raise ModelError(f"{self.name} acts on the whole world", expected="no target", found=list(self.target))
            return
        known = _names(m, self.kind)
        expected = f"{'bodies' if self.kind == 'body' else f'{self.kind}s'} among {known}"
        if self.parts:
            expected += f", after them {', '.join(self.parts)} or none"
        if unknown := [name for name in self.elements if name not in known]:
            raise ModelError(f"{self.name} has an unknown target", expected=expected, found=unknown)
        if not self.target:
            raise ModelError(f"{self.name} has no target", expected=expected, found="none")
        if unfit := [n for n, i in zip(self.elements, self.ids(m), strict=True) if not self.applies_to(m, int(i))]:
            raise ModelError(f"{self.name} cannot act on these targets", expected=self.requirement, found=unfit)

    def ids(self, m: mujoco.MjModel) -> np.ndarray:
        """Return the ids of the targets, shape (n,) int."""
        return np.array([mujoco.mj_name2id(m, OBJECTS[self.kind], name) for name in self.elements], dtype=int)

    def parameter_per_target(
        self, name: str, unit: str, null: Sequence[float] | np.ndarray | float, **rest: float
    ) -> tuple[Parameter, ...]:
        """Return one parameter an element; `rest` are the other entries of `Parameter`."""
        values = np.broadcast_to(np.asarray(null, dtype=float), (len(self.elements),))
        return tuple(
            Parameter(f"{name}[{t}]", unit, float(v), **rest)  # pyright: ignore[reportArgumentType]
            for t, v in zip(self.elements, values, strict=True)
        )


@dataclass(frozen=True)
class AddedEffect:
    """An effect with the values of its parameters, as a model has it."""

    effect: Effect
    values: tuple[float, ...]
    """Values, in the order of `Effect.parameters`."""
    intervals: tuple[tuple[float, float], ...] = ()
    """95 % intervals of the values, where they are known."""
    posterior: JointPosterior | None = None
    """Distribution of the values together with those of other effects that were fitted with it, where it is known."""
    first: int = 0
    """Index in it of the first value."""

    @cached_property
    def array(self) -> np.ndarray:
        """The values, shape (P,)."""
        return np.asarray(self.values, dtype=float)


def _names(m: mujoco.MjModel, kind: str) -> list[str]:
    """Return the names of a model's joints, tendons, actuators, bodies, geoms or sensors."""
    counts = {"joint": m.njnt, "tendon": m.ntendon, "actuator": m.nu, "body": m.nbody, "geom": m.ngeom}
    found = [mujoco.mj_id2name(m, OBJECTS[kind], i) for i in range((counts | {"sensor": m.nsensor})[kind])]
    return [name for name in found if name]


def prepare(spec: mujoco.MjSpec, effects: Sequence[AddedEffect]) -> None:
    """Edit an MJCF by effects, before it is compiled."""
    for added in effects:
        added.effect.prepare(spec)
    for added in effects:
        added.effect.edit(spec, added.array)


def write(m: mujoco.MjModel, effects: Sequence[AddedEffect]) -> None:
    """Set the fields of a compiled model by effects, in their order; its MJCF is prepared for them."""
    for added in effects:
        added.effect.write(m, added.array)


def variant_fields(
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
    first: dict[bytes, int] = {}
    for n, row in enumerate(values if chosen else ()):
        if (same := first.setdefault(row.tobytes(), n)) != n:
            for name in chosen:
                found[name][n] = found[name][same]
            continue
        variant = copy.copy(m)
        for effect, part in zip(effects, split, strict=True):
            effect.write(variant, row[part])
        for name in chosen:
            found[name][n] = _field(variant, name)
    return found


def _field(m: mujoco.MjModel, name: str) -> np.ndarray | float:
    """Return a field of a compiled model, ``opt.<name>`` for an option."""
    return getattr(m.opt, name[4:]) if name.startswith("opt.") else getattr(m, name)
