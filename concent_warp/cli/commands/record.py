"""``concent record``: demonstrations of a task in Reality."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.markup import escape

from concent_warp.checks import PositiveDuration
from concent_warp.cli.options import OutPath
from concent_warp.cli.terminal import progress_bar, quiet_warp, say, say_written
from concent_warp.errors import SceneError
from concent_warp.reality.expert.plan import Task
from concent_warp.reality.hidden.in_task import APPLICABLE, TaskWorld, parse_effects
from concent_warp.reality.hidden.registry import EVERY, hidden
from concent_warp.reality.record import RealityCfg, record
from concent_warp.reality.record_motion import record_motion, record_rig_motion, renumbered
from concent_warp.reality.rigs.registry import RIGS
from concent_warp.reality.rigs.rig import record_rig
from concent_warp.reality.world import HiddenEffect
from concent_warp.recording.cut import beginning
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.load import load_recording
from concent_warp.recording.recording import Recording
from concent_warp.run_folder import claim_file, make_folder
from concent_warp.scene.robot import RobotCfg
from concent_warp.scene.round_peg import RoundPegCfg
from concent_warp.scene.shape_sorter import ShapeSorterCfg
from concent_warp.scene.stacking import StackingCfg

TaskName = Literal["shape_sorter", "round_peg", "stacking"]
RigName = Literal["pendulum", "arm", "slide", "spin", "push", "drop", "tumble", "grasp", "insertion"]
RESHAPING = ("size", "contact_geometry")
"""Effects on the shape of an object, which the scene of a task cannot hide: Reality has shapes of its own there."""


@dataclass(frozen=True)
class Arguments:
    """Record demonstrations of a task, shown by a scripted expert in Reality, or given motions in its scene."""

    out: OutPath = Path("demo.h5")
    """Recording file to write."""
    seeds: tuple[int, ...] = (0,)
    """One demonstration for each seed: it determines the place of the block and the expert's offsets."""
    task: TaskName = "shape_sorter"
    """What is shown: a block put into a box, a round peg put into a hole, or a block put on another one. --reality.task
    has sizes and places of the shape sorter."""
    robot: Annotated[Path | None, tyro.conf.arg(name="robot")] = None
    """MJCF of another robot than the embedded arm."""
    tcp_site: Annotated[str, tyro.conf.arg(name="robot.tcp-site")] = RobotCfg.tcp_site
    """Site between that robot's fingertips: z points out of the hand, y along the closing direction."""
    gripper_actuators: Annotated[tuple[str, ...], tyro.conf.arg(name="robot.gripper-actuators")] = (
        RobotCfg.gripper_actuators
    )
    """Actuators that open that robot's gripper."""
    rig: RigName | None = None
    """A small experiment in place of a task; --reality does not apply to it."""
    motion: Path | None = None
    """Motion to perform in place of the demonstration, as concent suggest writes it; --seeds are those of the noise."""
    hide: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Effects that act in Reality and that the recording does not mention, such as joint_friction=1.2."""
    longest: PositiveDuration | None = None
    """Longest demonstration [s]; what comes later is left out."""
    overwrite: bool = False
    """Replace the file if it is there."""
    reality: RealityCfg = field(default_factory=RealityCfg)

    def demonstrated(self) -> Task:
        """Return the task with the robot asked for.

        Raises:
            SceneError: Another task than the shape sorter is asked for together with settings of the shape sorter.
        """
        task = self.reality.task
        if self.task != "shape_sorter":
            if task != ShapeSorterCfg():
                raise SceneError(
                    f"sizes and places of the shape sorter are given for the task {self.task}",
                    fix="leave --reality.task out",
                )
            task = RoundPegCfg() if self.task == "round_peg" else StackingCfg()
        if self.robot is None:
            return task
        return replace(task, robot=RobotCfg(self.robot, self.tcp_site, self.gripper_actuators))

    def effects(self) -> tuple[HiddenEffect, ...]:
        """Return the hidden effects asked for, made anew.

        Raises:
            ConcentError: One cannot be hidden there.
        """
        if self.rig is not None:
            rig = RIGS[self.rig]
            return tuple(hidden(name, value, rig).effect for name, value in parse_effects(self.hide, tuple(EVERY)))
        magnitudes = parse_effects(self.hide, [name for name in APPLICABLE if name not in RESHAPING])
        task = self.demonstrated()
        world = TaskWorld(
            task.build(), self.reality.world, task.objects[0], task.robot.gripper_actuators, tuple(magnitudes)
        )
        return tuple(one.effect for one in world.hidden())


def run(arguments: Arguments) -> Recording:
    """Record and write the file."""
    if arguments.robot is None and (
        arguments.tcp_site != RobotCfg.tcp_site or arguments.gripper_actuators != RobotCfg.gripper_actuators
    ):
        raise SceneError("names of another robot's parts are given without the robot", fix="add --robot ROBOT.xml")
    if arguments.rig is not None and (arguments.robot, arguments.task, arguments.reality) != (
        None, "shape_sorter", RealityCfg(),
    ):  # fmt: skip
        raise SceneError(
            "a rig has no task, robot or settings of Reality", fix="leave --task, --robot and --reality out"
        )
    motion = None if arguments.motion is None else load_recording(arguments.motion)
    effects = arguments.effects()
    claim_file(arguments.out, overwrite=arguments.overwrite)
    if arguments.reality.sensing.images or arguments.reality.footage.cameras:
        quiet_warp()
    with progress_bar("recording") as progress:
        recording = _recorded(arguments, motion, effects, progress)
    if arguments.longest is not None:
        recording = beginning(recording, arguments.longest)
    make_folder(arguments.out.parent)
    write_hdf5(recording, arguments.out)
    for demonstration in recording.demonstrations:
        end = demonstration.task
        if demonstration.success is not None:
            thing = arguments.demonstrated().objects[0]
            end = f"the {thing} is in its place" if demonstration.success else f"the {thing} missed its place"
        say(escape(f"{demonstration.name}: {demonstration.duration:.1f} s, {end}"))
    say_written(arguments.out)
    return recording


def _recorded(
    arguments: Arguments,
    motion: Recording | None,
    effects: tuple[HiddenEffect, ...],
    progress: Callable[[float], None],
) -> Recording:
    """Return the recording asked for, one of each seed after the other."""
    seeds, parts = arguments.seeds, []
    if arguments.rig is None and motion is None:
        return record(
            arguments.reality, list(seeds), task=arguments.demonstrated(), effects=effects, progress=progress
        )[0]
    for k, seed in enumerate(seeds):
        done = lambda share, k=k: progress((k + share) / len(seeds))  # noqa: E731
        if arguments.rig is not None:
            rig = RIGS[arguments.rig]
            parts.append(
                record_rig(rig, effects, 1, seed) if motion is None else record_rig_motion(rig, motion, effects, seed)
            )
        elif motion is not None:
            parts.append(
                record_motion(
                    arguments.reality,
                    motion,
                    task=arguments.demonstrated(),
                    effects=effects,
                    seed=seed,
                    progress=done,
                )
            )
        done(1.0)
    return renumbered(parts)
