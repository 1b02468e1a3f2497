"""Every hidden effect by name.

Each is implemented independently of the library's effect of that name, so that a diagnosis does not invert its own
code.
"""

from __future__ import annotations

from concent_warp.reality.hidden.contact import CONTACT
from concent_warp.reality.hidden.drives import DRIVES
from concent_warp.reality.hidden.gears import GEARS
from concent_warp.reality.hidden.hidden_effect import Builder, HiddenEffectOfRig
from concent_warp.reality.hidden.joints import JOINTS
from concent_warp.reality.hidden.measurement import MEASUREMENT
from concent_warp.reality.hidden.objects import OBJECTS
from concent_warp.reality.hidden.outside import OUTSIDE
from concent_warp.reality.hidden.surroundings import WORLD
from concent_warp.reality.rigs.rig import Rig

INSIDE: dict[str, Builder] = {**JOINTS, **DRIVES, **GEARS, **OBJECTS, **CONTACT, **WORLD, **MEASUREMENT}
"""Effects that the library has, by canonical name."""
EVERY: dict[str, Builder] = {**INSIDE, **OUTSIDE}


def hidden(name: str, magnitude: float, rig: Rig) -> HiddenEffectOfRig:
    """Return a hidden effect of a rig.

    Args:
        name: Canonical name, or one of `OUTSIDE`.
        magnitude: Value of its main parameter, in the parameter's unit.
        rig: The rig.

    Raises:
        KeyError: The name is unknown.
    """
    return EVERY[name](rig, magnitude)
