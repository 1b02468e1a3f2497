"""All rigs, by name."""

from __future__ import annotations

from concent_warp.reality.rig import Rig
from concent_warp.reality.rig_arm import ARM
from concent_warp.reality.rig_drop import DROP
from concent_warp.reality.rig_grasp import GRASP
from concent_warp.reality.rig_insertion import INSERTION
from concent_warp.reality.rig_pendulum import PENDULUM
from concent_warp.reality.rig_push import PUSH
from concent_warp.reality.rig_slide import SLIDE
from concent_warp.reality.rig_spin import SPIN
from concent_warp.reality.rig_tumble import TUMBLE

RIGS: dict[str, Rig] = {rig.name: rig for rig in (PENDULUM, ARM, SLIDE, SPIN, PUSH, DROP, TUMBLE, GRASP, INSERTION)}
