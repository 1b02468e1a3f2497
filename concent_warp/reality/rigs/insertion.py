"""The shape sorter as a rig, demonstrated by the scripted expert of `concent_warp.reality.record`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from concent_warp.reality.expert.plan import ExpertCfg
from concent_warp.reality.record import RealityCfg, record
from concent_warp.reality.rigs.rig import Rig, RigTrial, of_coarser_step
from concent_warp.reality.sensors.sensing import SensingCfg
from concent_warp.reality.world import HiddenEffect, WorldCfg
from concent_warp.recording.recording import Channel, Recording
from concent_warp.scene.scene import Scene
from concent_warp.scene.shape_sorter import ShapeSorterCfg

TASK = ShapeSorterCfg(timestep=0.002)


def _nominal_scene() -> Scene:
    """Return the scene with contacts as stiff as the time step allows."""
    spec = TASK.build().spec()
    for body in ("block", "box"):
        for geom in spec.body(body).geoms:
            geom.solref = [2 * TASK.timestep, 1.0]
    return Scene.from_spec(spec, source="insertion rig")


def _unplanned(rng: np.random.Generator, k: int) -> RigTrial:
    """Raise: the scripted expert plans the motion."""
    del rng, k
    raise NotImplementedError("insertions are recorded by the scripted expert")


def _record_insertion(effects: Sequence[HiddenEffect], demonstrations: int, seed: int) -> Recording:
    """Return a recording of the expert, with one seed for each demonstration."""

    def edit(spec: mujoco.MjSpec) -> None:
        for joint, armature in PHYSICS.armature.items():
            spec.joint(joint).armature += armature

    cfg = RealityCfg(
        task=TASK,
        expert=ExpertCfg(speed=0.7),
        world=WorldCfg(timestep=PHYSICS.timestep, solref=(0.003, 1.0)),
        sensing=SensingCfg(encoder_std=5e-4, point_rate=5.0, point_count=16, tracking_std=5e-5),
    )
    seeds = [1000 * seed + k for k in range(demonstrations)]
    recording, _ = record(cfg, seeds, effects=(HiddenEffect("finer step", edit=edit), *effects))
    shifted = [
        replace(d, measured={name: _earlier(channel) for name, channel in d.measured.items()}, points={}, success=None)
        for d in recording.demonstrations
    ]
    return Recording(SCENE.xml, tuple(shifted), source="reality rig insertion")


def _earlier(channel: Channel) -> Channel:
    """Return measurements shifted by the lead of the nominal time step; readings before time 0 are removed."""
    time = channel.time - PHYSICS.lead
    return replace(channel, time=time[time >= 0], value=channel.value[time >= 0])


SCENE = _nominal_scene()
PHYSICS = of_coarser_step(SCENE)
INSERTION = Rig(
    "insertion",
    SCENE,
    _unplanned,
    PHYSICS,
    start="resting",
    body="block",
    surface="table",
    grippers=("gripper",),
    pads=("left_finger_pad", "right_finger_pad"),
    recorder=_record_insertion,
)
