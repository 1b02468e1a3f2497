"""``concent distil``: a policy that sees, from one that observes the state."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from concent_warp.checks import Bounds, Count, Worlds
from concent_warp.cli.given_policy import check_policy, given_policy
from concent_warp.cli.options import DeviceOption, OptionalOutPath
from concent_warp.cli.terminal import quiet_warp, say, say_written, status_bar
from concent_warp.run_folder import TRAIN_CHECKPOINT, check_run_folder, processes
from concent_warp.train.distil.cfg import DistilCfg

if TYPE_CHECKING:
    from concent_warp.train.distil.student import Student
    from concent_warp.train.learning.ppo import Iteration


@dataclass(frozen=True)
class Arguments:
    """Train a student that acts by images as a trained policy, the teacher, acts by the state.

    The teacher labels the states that the student gets into (DAgger); colours, lights, cameras and delays are random.
    Writes the student to a run folder, and curves for TensorBoard. Ctrl-C loses nothing.
    On N GPUs: torchrun --nproc-per-node N -m concent_warp distil ..., each with --worlds of its own.
    """

    teacher: tyro.conf.Positional[Path]
    """Run folder of concent train, its checkpoint file, or the name of a policy that comes with the package."""
    out: OptionalOutPath = None
    """Run folder; by default runs/student_<name of the teacher>."""
    begin_with: Path | None = None
    """Run folder of a student to begin with, for other looks or a larger size of the images."""
    device: DeviceOption = None
    resume: bool = False
    """Continue an interrupted distillation, as if it had not stopped."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""
    worlds: Worlds | None = None
    """Parallel environments; short for --dagger.worlds."""
    iterations: Count | None = None
    """Iterations of collecting and learning; short for --dagger.iterations."""
    size: Annotated[int, Bounds(8, 1024)] | None = None
    """Height and width of the images [px]; short for --images.size."""
    blind: bool = False
    """Show the student black images, as a control; short for --network.blind."""
    distil: Annotated[DistilCfg, tyro.conf.arg(name="")] = field(default_factory=DistilCfg)

    def cfg(self) -> DistilCfg:
        """Return the settings with the short forms put in their places."""
        given = {"worlds": self.worlds, "iterations": self.iterations}
        dagger = replace(self.distil.dagger, **{name: value for name, value in given.items() if value is not None})
        images = self.distil.images if self.size is None else replace(self.distil.images, size=self.size)
        network = replace(self.distil.network, blind=self.blind or self.distil.network.blind)
        return replace(self.distil, dagger=dagger, images=images, network=network)


def run(arguments: Arguments) -> Student:
    """Distil and write the run folder, one of several processes where torchrun started them."""
    folder = arguments.out or Path("runs") / f"student_{arguments.teacher.stem}"
    if processes()[1] > 1:
        from concent_warp.train.learning.distributed import DistributedProcess

        DistributedProcess.from_environment().device(arguments.device)  # more processes than GPUs are refused here
    else:
        check_run_folder(folder, overwrite=arguments.overwrite, resume=arguments.resume)
    name = arguments.teacher.name
    pretrained = name if not arguments.teacher.exists() and str(arguments.teacher) == name else None
    given = (None if pretrained else arguments.teacher), pretrained
    check_policy(*given)
    cfg = arguments.cfg()
    teacher = given_policy(*given)
    quiet_warp()
    from concent_warp.deploy.distil import distil
    from concent_warp.train.distil.student import load_student

    begin_with = None if arguments.begin_with is None else load_student(arguments.begin_with)

    last: Iteration | None = None
    with status_bar("distilling") as update:

        def progress(this: Iteration) -> None:
            nonlocal last
            last = this
            total, log = cfg.dagger.iterations, this.log
            success = f", success {log['success']:.1%}" if "success" in log else ""
            text = f"{this.steps:,} samples, loss {log['loss action']:.4f}{success}, {this.rate:,.0f} steps/s"
            update(this.iteration / total, text, this.seconds / this.iteration * (total - this.iteration))

        student = distil(
            teacher,
            cfg,
            begin_with=begin_with,
            device=arguments.device,
            out=folder,
            resume=arguments.resume,
            overwrite=arguments.overwrite,
            progress=progress,
        )
    if last is None:
        say(f"nothing is left to learn: {cfg.dagger.iterations} iterations are done")
    else:
        driven = f", success of the episodes that it drives {last.log['success']:.1%}" if "success" in last.log else ""
        say(f"{last.steps:,} samples in {last.seconds:.0f} s{driven}")
    say_written(folder / TRAIN_CHECKPOINT)
    return student
