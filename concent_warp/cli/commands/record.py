"""``concent record``: demonstrations of the shape sorter in Reality."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from concent_warp.cli.options import OutPath
from concent_warp.cli.terminal import progress_bar, quiet_warp, say, say_written
from concent_warp.errors import SceneError
from concent_warp.reality.record import RealityCfg, record
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.recording import Recording
from concent_warp.run_folder import claim_file, make_folder
from concent_warp.scene.robot import RobotCfg


@dataclass(frozen=True)
class Arguments:
    """Record demonstrations of the shape sorter, shown by a scripted expert in Reality."""

    out: OutPath = Path("demo.h5")
    """Recording file to write."""
    seeds: tuple[int, ...] = (0,)
    """One demonstration for each seed: it determines the place of the block and the expert's offsets."""
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

    def reality_with_robot(self) -> RealityCfg:
        """Return the settings of Reality with the robot asked for."""
        if self.robot is None:
            return self.reality
        robot = RobotCfg(self.robot, self.tcp_site, self.gripper_actuators)
        return replace(self.reality, task=replace(self.reality.task, robot=robot))


def run(arguments: Arguments) -> Recording:
    """Record and write the file."""
    if arguments.robot is None and (
        arguments.tcp_site != RobotCfg.tcp_site or arguments.gripper_actuators != RobotCfg.gripper_actuators
    ):
        raise SceneError("names of another robot's parts are given without the robot", fix="add --robot ROBOT.xml")
    claim_file(arguments.out, overwrite=arguments.overwrite)
    if arguments.reality.sensing.images or arguments.reality.footage.cameras:
        quiet_warp()
    with progress_bar("recording") as progress:
        recording, _ = record(arguments.reality_with_robot(), list(arguments.seeds), progress=progress)
    make_folder(arguments.out.parent)
    write_hdf5(recording, arguments.out)
    for demonstration in recording.demonstrations:
        end = "the block is in the hole" if demonstration.success else "the block missed the hole"
        say(f"{demonstration.name}: {demonstration.duration:.1f} s, {end}")
    say_written(arguments.out)
    return recording
