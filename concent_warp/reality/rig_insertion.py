"""The shape sorter by the scripted expert as a rig: its recorder is that of `concent_warp.reality.record`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from concent_warp.reality.record import RealityCfg, record
from concent_warp.reality.rig import Rig, Trial
from concent_warp.reality.sensing import SensingCfg
from concent_warp.reality.world import HiddenEffect
from concent_warp.recording.recording import Recording
from concent_warp.scene.shape_sorter import ShapeSorterCfg

TASK = ShapeSorterCfg(timestep=0.002)


def unplanned(rng: np.random.Generator, k: int) -> Trial:
    """The expert plans for himself."""
    del rng, k
    raise NotImplementedError("insertions are recorded by the scripted expert")


def record_insertion(effects: Sequence[HiddenEffect], demonstrations: int, seed: int) -> Recording:
    """Record the expert; one seed of his own for each demonstration."""
    cfg = RealityCfg(task=TASK, sensing=SensingCfg(encoder_std=5e-4))
    recording, _ = record(cfg, [1000 * seed + k for k in range(demonstrations)], effects=tuple(effects))
    return recording


INSERTION = Rig(
    "insertion",
    TASK.build(),
    unplanned,
    start="resting",
    body="block",
    surface="table",
    grippers=("gripper",),
    pads=("left_finger_pad", "right_finger_pad"),
    recorder=record_insertion,
)
