"""All rigs, by name."""

from __future__ import annotations

from concent_warp.reality.rigs.arm import ARM
from concent_warp.reality.rigs.drop import DROP
from concent_warp.reality.rigs.grasp import GRASP
from concent_warp.reality.rigs.insertion import INSERTION
from concent_warp.reality.rigs.pendulum import PENDULUM
from concent_warp.reality.rigs.push import PUSH
from concent_warp.reality.rigs.rig import Rig
from concent_warp.reality.rigs.slide import SLIDE
from concent_warp.reality.rigs.spin import SPIN
from concent_warp.reality.rigs.tumble import TUMBLE

RIGS: dict[str, Rig] = {rig.name: rig for rig in (PENDULUM, ARM, SLIDE, SPIN, PUSH, DROP, TUMBLE, GRASP, INSERTION)}
