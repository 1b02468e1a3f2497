"""Hidden effects in Reality for a policy: those of the rigs, applied to a task's scene.

Excluded are effects that do not act on a policy: of sensors, since it observes the exact state (wrong joint zeros among
them), of the table under a sliding object, of air, and effects that add bodies.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from concent_warp.errors import ConcentError
from concent_warp.reality.fingers import actuator_names, pad_geoms
from concent_warp.reality.hidden.drives import DRIVES
from concent_warp.reality.hidden.gears import GEARS
from concent_warp.reality.hidden.hidden_effect import HiddenEffectOfRig
from concent_warp.reality.hidden.joints import JOINTS
from concent_warp.reality.hidden.objects import OBJECTS
from concent_warp.reality.hidden.registry import hidden
from concent_warp.reality.rigs.rig import Rig, RigTrial, WorldPhysics
from concent_warp.reality.world import WorldCfg
from concent_warp.scene.scene import Scene

APPLICABLE: tuple[str, ...] = (
    *JOINTS,
    *(name for name in DRIVES if name != "joint_offset"),
    *GEARS,
    *OBJECTS,
    *("grip_force", "pad_friction", "gravity_tilt", "cogging", "cable", "warming", "dropout"),
)
"""Effects that can be hidden."""


@dataclass(frozen=True)
class TaskWorld:
    """Reality for a task's scene, with hidden effects."""

    scene: Scene
    """The nominal scene."""
    physics: WorldCfg
    body: str
    """The manipulated object, on which effects on a body act."""
    grippers: tuple[str, ...] = ()
    """Actuators that grasp it."""
    magnitudes: tuple[tuple[str, float], ...] = ()
    """Names of the hidden effects with their magnitudes, in the unit of their main parameter."""

    def __post_init__(self) -> None:
        names = [name for name, _ in self.magnitudes]
        if "pad_friction" in names and not pad_geoms(self.scene.model, self.grippers):
            raise ConcentError(
                "pad_friction cannot be hidden: no geom of the fingers has a name", where=self.scene.source
            )

    def rig(self) -> Rig:
        """Return the rig for which the effects are made."""
        m = self.scene.model
        return Rig(
            "task",
            self.scene,
            no_plan,
            WorldPhysics(timestep=self.physics.timestep),
            body=self.body,
            grippers=tuple(name for name in self.grippers if name in actuator_names(m)),
            pads=pad_geoms(m, self.grippers),
        )

    def hidden(self) -> tuple[HiddenEffectOfRig, ...]:
        """Return the effects, made anew: many have a state, so that each world needs its own."""
        rig = self.rig()
        return tuple(hidden(name, magnitude, rig) for name, magnitude in self.magnitudes)

    def spec(self) -> mujoco.MjSpec:
        """Return the world with the effects in it."""
        nominal, rest = self.scene.spec(), []
        for one in self.hidden():
            # The world turns boxes into chamfered ones: what an object is has to be said before.
            if one.name in OBJECTS and one.effect.edit is not None:
                one.effect.edit(nominal)
            else:
                rest.append(one.effect)
        scene = self.scene
        if len(rest) < len(self.magnitudes):
            scene = Scene.from_spec(nominal, source=scene.source)
        return self.physics.build(scene, tuple(rest))

    def compile(self) -> mujoco.MjModel:
        """Return the compiled world.

        Raises:
            ConcentError: A magnitude makes no world.
        """
        try:
            return self.spec().compile()
        except (ValueError, ZeroDivisionError, mujoco.FatalError) as error:
            found = (
                f"{', '.join(f'{name}={value:g}' for name, value in self.magnitudes)}: {' '.join(str(error).split())}"
            )
            raise ConcentError("Reality cannot be built with these hidden effects", found=found) from None


def parse_effects(given: Sequence[str], among: Collection[str] = APPLICABLE) -> tuple[tuple[str, float], ...]:
    """Return names and magnitudes of effects written as ``name=value``.

    Args:
        given: What was written.
        among: Effects that can be hidden.

    Raises:
        ConcentError: One is written otherwise, is not there, or is given twice.
    """
    found: dict[str, float] = {}
    for text in given:
        name, _, number = text.partition("=")
        try:
            value = float(number)
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise ConcentError(
                "a hidden effect is not right", expected="name=value, as in joint_friction=1.2", found=repr(text)
            )
        if name not in among:
            raise ConcentError(f"no effect {name!r} can be hidden", expected=f"one of {', '.join(among)}")
        if name in found:
            raise ConcentError("an effect is hidden twice", found=name)
        found[name] = value
    return tuple(found.items())


def no_plan(rng: np.random.Generator, k: int) -> RigTrial:
    """Raise an error: the motion of a task is the policy's, and none is planned."""
    del rng, k
    raise NotImplementedError("a policy moves the world of a task")
