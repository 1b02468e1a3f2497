"""``concent render``: episodes of a policy, or a recording, as images that look like the real camera's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from concent_warp.cli.given_policy import Pretrained, given_checkpoint
from concent_warp.cli.run_folder import (
    SETTINGS,
    check_unchanged,
    claim_file,
    make_folder,
    plain,
    resuming_command,
    run_folder,
    write_settings,
)
from concent_warp.cli.terminal import progress_bar, quiet_warp, say, say_written
from concent_warp.errors import RenderError
from concent_warp.render.shadow_cfg import ShadowCfg
from concent_warp.scene.cameras import BASE, WRIST

if TYPE_CHECKING:
    import mujoco

    from concent_warp.model import Model
    from concent_warp.render.composite import HybridCamera
    from concent_warp.render.dataset.layout import DatasetWriter, EpisodeLayout
    from concent_warp.render.filming import Filming


FREE = ("out", "resume", "overwrite", "recording", "episodes", "worlds", "films", "figure", "device")
"""Settings with which a data set may be gone on with that differ from those that it was begun with."""


@dataclass(frozen=True)
class Arguments:
    """Render episodes of a trained policy, or a recording, to a data set for vision-language-action policies.

    Without networks and splats the images are the simulation's. With networks (concent render-train), robot and
    background look as the real camera sees them; with splats (concent splat-fit, or any 3DGS model), so do the objects.
    Images, state and commands go to a LeRobotDataset v3.0 or to robomimic's HDF5. Ctrl-C loses nothing.
    """

    checkpoint: Path | None = None
    """Run folder of a training, or its checkpoint file."""
    pretrained: Pretrained = None
    """Render a policy that comes with the package, shape_sorter where no name is given."""
    recording: Path | None = None
    """Render the measured motion of a recording instead of a policy."""
    out: Path = Path("runs/dataset")
    """Folder of the data set."""
    format: Literal["lerobot", "robomimic"] = "lerobot"
    """LeRobotDataset v3.0, or one HDF5 file in robomimic's layout."""
    episodes: int = 20
    """Initial states of the policy, of which each makes an episode."""
    keep: Literal["successes", "all"] = "successes"
    """Which episodes of a policy go into the data set."""
    task: str | None = None
    """What is done, in words; by default what the demonstration says."""
    networks: Path | None = None
    """Run folder of concent render-train; its cameras are rendered."""
    splats: tuple[str, ...] = ()
    """Looks of objects, each as body=file.ply, in metres and the body's frame."""
    shadows: bool = True
    """Whether objects with splats cast shadows, under lights drawn anew for each episode."""
    cameras: tuple[str, ...] = ()
    """Cameras to render; by default those of the networks, else base and wrist, which a scene without any is given."""
    size: int = 256
    """Height and width of the images [px]."""
    show: Literal["visual", "spheres"] = "visual"
    """What the raw image shows of the objects: their shapes, or the contact spheres."""
    rate: int = 10
    """Frames a second of a recording; those of a policy come at its own rate."""
    worlds: int = 8
    """Episodes rendered side by side."""
    flow_steps: int = 4
    """Steps of the flow from noise to image; fewer are quicker."""
    half: bool = False
    """Let the networks multiply in bfloat16, which is quicker on a GPU."""
    codec: Literal["h264", "av1"] = "h264"
    """How the videos of a LeRobotDataset are encoded."""
    films: int = 0
    """How many of the first episodes to write as MP4 besides, the cameras side by side."""
    figure: Path | None = None
    """File (.png or .pdf) for a figure of the layers that the first episode's images are made of."""
    seed: int = 0
    """Seed of initial states, lights and noise."""
    device: str | None = None
    """Warp's name of the device; the first CUDA device by default where there is one."""
    resume: bool = False
    """Go on with an interrupted data set, or with more episodes than it had."""
    overwrite: bool = False
    """Replace an earlier data set in the folder."""
    lights: ShadowCfg = field(default_factory=ShadowCfg)
    """Lights of the shadows."""


def run(arguments: Arguments) -> int:
    """Render, write the data set, and return how many episodes it holds."""
    quiet_warp()
    if (arguments.recording is not None) == (arguments.checkpoint is not None or arguments.pretrained is not None):
        raise RenderError("one thing is to be rendered", expected="either --recording, or --checkpoint or --pretrained")
    if min(arguments.episodes, arguments.worlds, arguments.rate, arguments.flow_steps) < 1:
        raise RenderError("episodes, worlds, rate and steps of the flow are to be at least 1")
    if arguments.figure is not None:
        claim_file(arguments.figure, overwrite=arguments.overwrite)
    check_replaced(arguments)
    with run_folder(arguments.out, overwrite=False, resume=arguments.resume or arguments.overwrite):
        try:
            filming = film_recording(arguments) if arguments.recording is not None else film_policy(arguments)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"What is done is saved; go on with: {resuming_command()}") from None
        count = filming.writer.finish()
    draw_figure(arguments, filming)
    say(f"the data set holds {count} episode{'s' * (count != 1)}")
    say_written(arguments.out)
    return count


def check_replaced(arguments: Arguments) -> None:
    """Check that what is to be replaced is a data set.

    Raises:
        RenderError: The folder holds another run.
    """
    from concent_warp.render.dataset.layout import STAGING

    folder = arguments.out
    if arguments.overwrite and (folder / SETTINGS).is_file() and not (folder / STAGING).is_dir():
        raise RenderError("the folder holds a run, but no data set", where=folder, fix="choose another folder")


def film_policy(arguments: Arguments) -> Filming:
    """Film the episodes of a policy."""
    import torch

    from concent_warp.train.environment.worlds import make_environment
    from concent_warp.train.learning.ppo import Trainer, load_checkpoint
    from concent_warp.train.policy.episodes import start, steps
    from concent_warp.train.run import Run

    path = given_checkpoint(arguments.checkpoint, arguments.pretrained)
    made = Run.load(path.parent)
    task = made.task()
    states = made.evaluation_states(task, arguments.episodes, arguments.seed)
    torch.manual_seed(arguments.seed)
    worlds = min(arguments.worlds, arguments.episodes)
    cfg = replace(made.cfg.environment, worlds=worlds, capture="physics")
    environment = make_environment(task, cfg, states, device=arguments.device)
    trainer = Trainer(environment, made.cfg)
    trainer.algorithm.load(load_checkpoint(path, str(environment.device)), {"actor": True}, True)
    policy = trainer.policy()
    rate = round(1 / environment.control_step)
    if abs(rate * environment.control_step - 1) > 1e-6:
        raise RenderError("a video wants a whole number of frames a second", found=1 / environment.control_step)
    camera, model = hybrid_camera(arguments, task.model, worlds)
    joints, layout = addressed(model, camera, rate)
    writer = dataset_writer(arguments, layout)
    filming = new_filming(arguments, camera, writer, arguments.task or made.recording[0].task or "do the task", rate)
    left = [row for row in range(arguments.episodes) if not writer.has(row)]
    physics, length = environment.physics, int(environment.max_episode_length)
    with progress_bar("rendering") as progress, leaving(filming):
        for first in range(0, len(left), worlds):
            rows = left[first : first + worlds]
            start(environment, rows)
            filming.begin([*rows, *[None] * (worlds - len(rows))])
            filming.shoot(physics.qpos, physics.mocap)
            state = physics.qpos.cpu().numpy()[:, joints]
            for k, step in enumerate(steps(environment, policy)):
                for world in filming.running:
                    filming.add(world, state[world], step.command[world])
                    if step.ended[world]:
                        success = bool(step.success[world])
                        filming.end(world, keep=arguments.keep == "all" or success, success=success)
                progress((first + len(rows) * (k + 1) / length) / len(left))
                if not filming.running:
                    break
                filming.shoot(physics.qpos, physics.mocap)
                state = physics.qpos.cpu().numpy()[:, joints]
    if filming.dropped:
        say(f"{filming.dropped} of {filming.dropped + filming.kept} episodes were no success and are left out")
    return filming


def film_recording(arguments: Arguments) -> Filming:
    """Film the measured motion of the demonstrations of a recording, each an episode."""
    from concent_warp.estimation.measured_motion import measured_motion
    from concent_warp.model import Model
    from concent_warp.recording.load import load_recording
    from concent_warp.scene.scene import Scene
    from concent_warp.simulate.mujoco_engine import MujocoEngine
    from concent_warp.simulate.replay import commands

    assert arguments.recording is not None
    recording = load_recording(arguments.recording)
    model = Model(Scene(recording.scene, source=recording.source))
    engine = MujocoEngine(model, threads=1)
    camera, compiled = hybrid_camera(arguments, model, 1)
    joints, layout = addressed(compiled, camera, arguments.rate)
    writer = dataset_writer(arguments, layout)
    task = arguments.task or recording[0].task or "do the task"
    filming = new_filming(arguments, camera, writer, task, arguments.rate)
    with progress_bar("rendering") as progress, leaving(filming):
        for k, demonstration in enumerate(recording.demonstrations):
            if writer.has(k):
                continue
            motion = measured_motion(model, demonstration, engine)
            time = np.arange(motion.span[0], motion.span[1], 1 / arguments.rate)
            qpos = motion.states(time)[0]
            ctrl = commands(compiled, demonstration, round(time[-1] / engine.timestep) + 1)
            filming.begin([k])
            for t, now in enumerate(time):
                filming.shoot(qpos[t][None])
                filming.add(0, qpos[t][joints], ctrl[round(now / engine.timestep)])
                progress((k + (t + 1) / len(time)) / len(recording.demonstrations))
            filming.end(0, keep=True)
    return filming


@contextmanager
def leaving(filming: Filming) -> Iterator[None]:
    """Forget the episodes that have not ended when something goes wrong."""
    try:
        yield
    except BaseException:
        filming.leave()
        raise


def hybrid_camera(arguments: Arguments, given: Model, worlds: int) -> tuple[HybridCamera, mujoco.MjModel]:
    """Return what renders, and the scene's model with the cameras."""
    import warp as wp

    from concent_warp.model import Model
    from concent_warp.render.cameras import place_cameras
    from concent_warp.render.composite import HybridCamera
    from concent_warp.render.networks.painter import Painter
    from concent_warp.render.splats.splats import Splats
    from concent_warp.scene.cameras import with_cameras
    from concent_warp.simulate.warp_engine import preferred_device

    device = arguments.device or preferred_device()
    where = str(wp.device_to_torch(wp.get_device(device)))
    painter = None
    if arguments.networks is not None:
        options = {"steps": arguments.flow_steps, "seed": arguments.seed, "half": arguments.half}
        painter = Painter.load(arguments.networks, device=where, **options)
    names = arguments.cameras or (tuple(painter.cameras) if painter is not None else (BASE, WRIST))
    scene = given.scene
    own = [] if painter is None else [painter.cameras[name] for name in names if name in painter.cameras]
    others = [name for name in names if name not in [camera.name for camera in own]]
    spec = Model(with_cameras(scene, others), given.geometry).spec()
    place_cameras(spec, own)
    model = spec.compile()
    splats = {}
    for text in arguments.splats:
        body, _, file = text.partition("=")
        if not file:
            raise RenderError("splats are given as body=file.ply", found=repr(text))
        splats[body] = Splats.read(Path(file), device=where)
    camera = HybridCamera(
        model, names, (arguments.size, arguments.size), worlds, objects=scene.objects(), splats=splats,
        painter=painter, shadows=arguments.lights if arguments.shadows else None, show=arguments.show, device=device,
        seed=arguments.seed,
    )  # fmt: skip
    return camera, model


def addressed(model: mujoco.MjModel, camera: HybridCamera, rate: int) -> tuple[np.ndarray, EpisodeLayout]:
    """Return where the joints of one degree of freedom are in qpos, and the layout of a data set of them."""
    import mujoco

    from concent_warp.render.dataset.layout import EpisodeLayout

    single = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    joints = [j for j in range(model.njnt) if int(model.jnt_type[j]) in single]
    layout = EpisodeLayout(
        rate,
        camera.cameras,
        camera.size,
        tuple(model.joint(j).name for j in joints),
        tuple(model.actuator(i).name for i in range(model.nu)),
    )
    return model.jnt_qposadr[joints], layout


def dataset_writer(arguments: Arguments, layout: EpisodeLayout) -> DatasetWriter:
    """Return the data set, new or to go on with; only here, where all that was given is right, one is replaced."""
    import shutil

    if arguments.overwrite and not arguments.resume:
        for path in arguments.out.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    settings = replace(arguments, resume=False, overwrite=False)
    if arguments.resume:
        check_unchanged(arguments.out / SETTINGS, plain(settings), FREE)
    write_settings(arguments.out, settings)
    if arguments.format == "robomimic":
        from concent_warp.render.dataset.robomimic import RobomimicWriter

        return RobomimicWriter(arguments.out, layout)
    from concent_warp.render.dataset.lerobot import LeRobotWriter

    return LeRobotWriter(arguments.out, layout, codec=arguments.codec)


def new_filming(arguments: Arguments, camera: HybridCamera, writer: DatasetWriter, task: str, rate: int) -> Filming:
    """Return what takes the frames to the data set."""
    from concent_warp.render.filming import FILMS, Filming

    return Filming(
        camera, writer, task, films=arguments.out / FILMS if arguments.films else None,
        first_films=arguments.films, rate=rate,
    )  # fmt: skip


def draw_figure(arguments: Arguments, filming: Filming) -> None:
    """Write the figure that was asked for."""
    if arguments.figure is None:
        return
    if not len(filming.album):
        say("no frame was rendered anew, so that there is no figure")
        return
    from concent_warp.render.figure import decomposition

    make_folder(arguments.figure.parent)
    decomposition(filming.album.chosen(), filming.camera.cameras, arguments.figure)
    say_written(arguments.figure)
