"""Every hidden effect by name.

Each is made by means of its own, so that finding it is not reading the same code backwards.
"""

from __future__ import annotations

from concent_warp.reality.hidden_case import Builder, Hidden
from concent_warp.reality.hidden_contact import CONTACT
from concent_warp.reality.hidden_drives import DRIVES
from concent_warp.reality.hidden_gears import GEARS
from concent_warp.reality.hidden_joints import JOINTS
from concent_warp.reality.hidden_measurement import MEASUREMENT
from concent_warp.reality.hidden_objects import OBJECTS
from concent_warp.reality.hidden_outside import OUTSIDE
from concent_warp.reality.hidden_world import WORLD
from concent_warp.reality.rig import Rig

INSIDE: dict[str, Builder] = {**JOINTS, **DRIVES, **GEARS, **OBJECTS, **CONTACT, **WORLD, **MEASUREMENT}
"""Effects that a library of effects has, by canonical name."""
EVERY: dict[str, Builder] = {**INSIDE, **OUTSIDE}


def hidden(name: str, magnitude: float, rig: Rig) -> Hidden:
    """Return an effect to be hidden in a rig.

    Args:
        name: Canonical name, or one of `OUTSIDE`.
        magnitude: Value of its main parameter, in the parameter's unit.
        rig: Where.

    Raises:
        KeyError: There is no such effect.
    """
    return EVERY[name](rig, magnitude)
