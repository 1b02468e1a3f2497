"""``concent record``: demonstrations of a task in Reality."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from concent_warp.cli.options import OutPath
from concent_warp.cli.terminal import progress_bar, quiet_warp, say, say_written
from concent_warp.errors import SceneError
from concent_warp.reality.expert.plan import Task
from concent_warp.reality.record import RealityCfg, record
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.recording import Recording
from concent_warp.run_folder import claim_file, make_folder
from concent_warp.scene.robot import RobotCfg
from concent_warp.scene.round_peg import RoundPegCfg
from concent_warp.scene.shape_sorter import ShapeSorterCfg
from concent_warp.scene.stacking import StackingCfg

TaskName = Literal["shape_sorter", "round_peg", "stacking"]


@dataclass(frozen=True)
class Arguments:
    """Record demonstrations of a task, shown by a scripted expert in Reality."""

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


def run(arguments: Arguments) -> Recording:
    """Record and write the file."""
    if arguments.robot is None and (
        arguments.tcp_site != RobotCfg.tcp_site or arguments.gripper_actuators != RobotCfg.gripper_actuators
    ):
        raise SceneError("names of another robot's parts are given without the robot", fix="add --robot ROBOT.xml")
    task = arguments.demonstrated()
    claim_file(arguments.out, overwrite=arguments.overwrite)
    if arguments.reality.sensing.images or arguments.reality.footage.cameras:
        quiet_warp()
    with progress_bar("recording") as progress:
        recording, _ = record(arguments.reality, list(arguments.seeds), task=task, progress=progress)
    make_folder(arguments.out.parent)
    write_hdf5(recording, arguments.out)
    for demonstration in recording.demonstrations:
        end = (
            f"the {task.objects[0]} is in its place"
            if demonstration.success
            else f"the {task.objects[0]} missed its place"
        )
        say(f"{demonstration.name}: {demonstration.duration:.1f} s, {end}")
    say_written(arguments.out)
    return recording
