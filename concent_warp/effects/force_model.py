"""Forces that MuJoCo has no field for: recomputed from the state before each step, on both engines.

A force model writes to what the engine clears or restores before each step (`qfrc_applied`, `xfrc_applied`) or
overwrites (`dof_frictionloss`). It sees positions and velocities of this step; what MuJoCo derives from them (forces,
contacts) is still that of the step before.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import mujoco
import numpy as np

from concent_warp.effects.compiled_forces import Numbers, Row, StepState

if TYPE_CHECKING:
    import mujoco_warp as mjw
    import warp as wp


class ForceModel:
    """A force model with P parameters; what it acts on is fixed when it is made.

    Two force models are equal if they are of one class and act on the same elements; equal ones share a captured graph.
    """

    edits: ClassVar[tuple[str, ...]] = ()
    """Fields of the compiled model that it overwrites."""

    acts: Callable[[bool, Numbers, Numbers, StepState], None] | None = None
    """A function of `compiled_forces.FORCES`, which acts on one element by a row of numbers.

    Its arguments: whether this is not the first step, indices, numbers, and MuJoCo's arrays. None for force models that
    are Python alone.
    """

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self._acts_on() == other._acts_on()  # pyright: ignore[reportAttributeAccessIssue]

    def __hash__(self) -> int:
        return hash((type(self), self._acts_on()))

    def _acts_on(self) -> tuple[tuple[str, Any], ...]:
        """Return the public attributes, arrays as bytes."""
        rows = sorted((name, value) for name, value in vars(self).items() if not name.startswith("_"))
        return tuple((name, value.tobytes() if isinstance(value, np.ndarray) else value) for name, value in rows)

    def apply(self, m: mujoco.MjModel, d: mujoco.MjData, values: np.ndarray) -> None:
        """Apply it in C MuJoCo to the coming step.

        Args:
            m: Model of this variant alone; `edits` may be overwritten.
            d: Its data; to be added to: `qfrc_applied` (nv,) [N m or N], `xfrc_applied` (nbody, 6) [N, N m].
            values: Parameters, shape (P,).
        """
        if self.acts is None and type(self).bound is ForceModel.bound:
            raise NotImplementedError
        self.bound(m, d, values)()

    def rows(self, m: mujoco.MjModel, values: np.ndarray) -> list[Row]:
        """Return indices and numbers of each element that `acts` acts on, in their order; arguments as of `apply`."""
        raise NotImplementedError

    def bound(self, m: mujoco.MjModel, d: mujoco.MjData, values: np.ndarray) -> Callable[[], None]:
        """Return `apply` for the steps of one simulation, in Python: constants are looked up once."""
        act = self.acts
        if act is None:
            return lambda: self.apply(m, d, values)
        state, rows = StepState.of(m, d), self.rows(m, values)

        def step() -> None:
            begun = d.time > 0
            for whole, real in rows:
                act(begun, whole, real, state)

        return step

    def launch(self, m: mjw.Model, d: mjw.Data, values: wp.array[Any]) -> None:
        """Launch the same in MuJoCo-Warp, for all worlds.

        Args:
            m: Model; `edits` have one row a world.
            d: Data.
            values: Parameters, shape (N, P), float32.

        Raises:
            EngineError: The force model runs in C MuJoCo only.
        """
        from concent_warp.errors import EngineError

        del m, d, values
        raise EngineError(f"{type(self).__name__} cannot run on MuJoCo-Warp", fix="use the mujoco engine")
