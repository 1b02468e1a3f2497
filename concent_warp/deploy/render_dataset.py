"""Episodes of a policy, or a recording, as images in a data set for vision-language-action policies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.checks import check_device, check_settings
from concent_warp.deploy.cfg import Format, RenderCfg, splat_files
from concent_warp.errors import RenderError
from concent_warp.run_folder import (
    SETTINGS,
    check_unchanged,
    claim_file,
    make_folder,
    plain,
    run_folder,
    write_settings,
)
from concent_warp.scene.cameras import BASE, WRIST

if TYPE_CHECKING:
    from concent_warp.deploy.handover import Handover
    from concent_warp.deploy.simulated_images import RandomisedCamera
    from concent_warp.model import Model
    from concent_warp.recording.recording import Recording
    from concent_warp.render.composite import HybridCamera
    from concent_warp.render.dataset.layout import DatasetWriter, EpisodeLayout
    from concent_warp.render.filming import DatasetFilming, FilmCamera
    from concent_warp.train.distil.student import Student
    from concent_warp.train.environment.environment import Environment
    from concent_warp.train.flow.policy import FlowPolicy
    from concent_warp.train.policy.load import Policy
    from concent_warp.train.task.task import Task
    from concent_warp.train.trials.episodes import PolicyFunction

FREE = ("out", "resume", "overwrite", "source", "episodes", "worlds", "films", "figure", "device")
"""Settings that may differ when a data set is continued."""


@dataclass(frozen=True)
class Dataset:
    """A data set that was written.

    Example:
        >>> import concent_warp as cw
        >>> cfg = cw.RenderCfg(size=32, cameras=("base",))
        >>> dataset = cw.render(cw.load_policy("shape_sorter").run.recording, "dataset", cfg, format="robomimic")
        >>> dataset.episodes
        1
    """

    folder: Path
    format: Format
    episodes: int
    """Episodes that it holds."""
    dropped: int = 0
    """Episodes of the policy that were no success and were left out in this call."""
    figure: Path | None = None
    """The figure of the layers; None without one."""


def render(
    source: Policy | Recording,
    out: str | Path,
    cfg: RenderCfg | None = None,
    *,
    driver: Policy | Student | FlowPolicy | None = None,
    format: Format = "lerobot",
    device: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Dataset:
    """Render episodes of a policy, or the measured motion of a recording, to a data set.

    Without networks and splats the images are the simulation's. With networks, robot and background look as the real
    camera sees them; with splats, so do the objects.

    Args:
        source: The policy, whose episodes in simulation are rendered, or a recording.
        out: Folder of the data set.
        cfg: Settings.
        driver: Policy that acts at the beginning of each episode, for a random time, before it hands over to `source`;
            a flow policy sees the images of the data set, a student its own. None for none.
        format: LeRobotDataset v3.0, or one HDF5 file in robomimic's layout.
        device: Warp's name of the device; the first CUDA device by default where there is one.
        resume: Continue an interrupted data set, or one with fewer episodes.
        overwrite: Replace an earlier data set in the folder.
        progress: Called with the share done, 0..1.

    Raises:
        RenderError: A setting is out of bounds, the folder holds something else, or a recording has a driver.
        TrainError: The driver does not fit the task.
        ConcentError: A file is there already, or the data set was begun with other settings.

    Example:
        >>> import concent_warp as cw
        >>> cfg = cw.RenderCfg(episodes=1, size=32, cameras=("base",), keep="all")
        >>> cw.render(cw.load_policy("shape_sorter"), "dataset", cfg, format="robomimic", device="cpu").episodes
        1
    """
    cfg, out = cfg or RenderCfg(), Path(out)
    check_settings(cfg, RenderError)
    check_device(device)
    _check_randomised(cfg)
    if cfg.figure is not None:
        claim_file(cfg.figure, overwrite=overwrite or resume)
    _check_replaced(out, overwrite=overwrite)
    if driver is not None and cfg.handover.frames == "labelled" and format != "lerobot":
        fix = "render a LeRobot data set, or other --handover.frames"
        raise RenderError("this format has no place for labels", expected="lerobot", found=format, fix=fix)
    with run_folder(out, overwrite=overwrite, resume=resume, keep_folders=False) as claimed:
        to = Destination(claimed.path, cfg, format, device, resume, driver)
        from concent_warp.recording.recording import Recording

        if cfg.randomise and isinstance(source, Recording):
            raise RenderError("random looks are those of a policy's task", expected="a policy", found="a recording")
        if driver is not None and isinstance(source, Recording):
            raise RenderError("a recording is not driven", expected="a policy that takes over", found="a recording")
        film = _film_recording if isinstance(source, Recording) else _film_policy
        filming = film(source, to, progress or _ignore)  # pyright: ignore[reportArgumentType]
        count = filming.writer.finish()
    return Dataset(out, format, count, filming.dropped, _draw_figure(cfg, filming))


@dataclass(frozen=True)
class Destination:
    """Where a data set goes, and how."""

    out: Path
    cfg: RenderCfg
    format: Format
    device: str | None
    resume: bool
    driver: Policy | Student | FlowPolicy | None = None


def _ignore(share: float) -> None:
    """Do nothing with the progress."""
    del share


def _check_randomised(cfg: RenderCfg) -> None:
    """Check that random looks are not asked for with what has looks of its own.

    Raises:
        RenderError: They are.
    """
    given = {"networks": cfg.networks, "splats": cfg.splats, "figure": cfg.figure, "show": cfg.show != "visual"}
    if cfg.randomise and (others := [name for name, value in given.items() if value]):
        expected = "no networks, splats, figure of layers or spheres"
        raise RenderError("random looks are of the ray-traced scene alone", expected=expected, found=", ".join(others))


def _check_replaced(folder: Path, *, overwrite: bool) -> None:
    """Check that what is to be replaced is a data set.

    Raises:
        RenderError: The folder holds another run.
    """
    from concent_warp.render.dataset.layout import STAGING

    if overwrite and (folder / SETTINGS).is_file() and not (folder / STAGING).is_dir():
        raise RenderError("the folder holds a run, but no data set", where=folder, fix="choose another folder")


def _film_policy(policy: Policy, to: Destination, progress: Callable[[float], None]) -> DatasetFilming:
    """Render the episodes of a policy."""
    import torch

    from concent_warp.train.environment.worlds import make_environment
    from concent_warp.train.flow.dataset import LABELS, label_names
    from concent_warp.train.trials.episodes import SUCCESS, Episodes

    cfg, run = to.cfg, policy.run
    task = run.task()
    states = run.evaluation_states(task, cfg.episodes, cfg.seed)
    torch.manual_seed(cfg.seed)
    worlds = min(cfg.worlds, cfg.episodes)
    settings = replace(run.cfg.environment, worlds=worlds, capture="physics")
    if to.driver is not None:
        settings = replace(settings, episode=settings.seconds + cfg.handover.time[1])
    environment = make_environment(task, settings, states, device=to.device)
    act = policy.act_in(environment)
    rate = round(1 / environment.control_step)
    if abs(rate * environment.control_step - 1) > 1e-6:
        raise RenderError("a video needs a whole number of frames per second", found=1 / environment.control_step)
    if cfg.randomise:
        camera, model = _task_camera(cfg, task, worlds, str(environment.device))
    else:
        camera, model = _hybrid_camera(cfg, task.model, worlds, to.device)
    joints, layout = _addressed(model, camera, rate)
    labelled = to.driver is not None and cfg.handover.frames == "labelled"
    if labelled:
        layout = replace(layout, more=((LABELS, label_names(layout.action, cfg.handover.chunk)),))
    writer = _dataset_writer(to, layout, model)
    filming = _new_filming(to, camera, writer, cfg.task or run.recording[0].task or "do the task", rate)
    handover = None if to.driver is None else _handover(environment, policy, act, filming, to)
    act = act if handover is None else handover.act
    left = [row for row in range(cfg.episodes) if not writer.has(row)]
    unknown = np.full(len(layout.action) * cfg.handover.chunk, np.nan, dtype=np.float32)
    physics, length = environment.physics, int(environment.max_episode_length)
    with _leaving(filming):
        for first in range(0, len(left), worlds):
            rows = left[first : first + worlds]
            episodes = Episodes(environment, act, rows)
            filming.begin([*rows, *[None] * (worlds - len(rows))])
            if handover is not None:
                handover.begin(rows)
            filming.shoot(physics.qpos, physics.mocap)
            state = physics.qpos.cpu().numpy()[:, joints]
            for step in episodes:
                for world in filming.running:
                    recorded = handover is None or handover.is_recorded(world)
                    label = None if handover is None else handover.label(world)
                    command = step.command[world] if label is None else label[0]
                    more = {LABELS: unknown if label is None else label.ravel()} if labelled else None
                    filming.add(world, state[world], command, recorded=recorded, more=more)
                    if world in step.outcome:
                        success = step.outcome[world] == SUCCESS
                        shown = labelled or handover is None or handover.has_taken_over(world)
                        filming.end(world, keep=shown and (cfg.keep == "all" or success), success=success)
                progress((first + len(rows) * episodes.length / length) / len(left))
                if not filming.running:
                    break
                filming.shoot(physics.qpos, physics.mocap)
                state = physics.qpos.cpu().numpy()[:, joints]
    return filming


def _film_recording(recording: Recording, to: Destination, progress: Callable[[float], None]) -> DatasetFilming:
    """Render the measured motion of the demonstrations of a recording, each an episode."""
    from concent_warp.estimation.state_estimator import StateEstimator, StateEstimatorCfg
    from concent_warp.model import Model
    from concent_warp.scene.scene import Scene
    from concent_warp.simulate.mujoco_engine import MujocoEngine
    from concent_warp.simulate.replay import commands

    cfg = to.cfg
    model = Model(Scene(recording.scene, source=recording.source))
    engine = MujocoEngine(model, threads=1)
    camera, compiled = _hybrid_camera(cfg, model, 1, to.device)
    joints, layout = _addressed(compiled, camera, cfg.rate)
    writer = _dataset_writer(to, layout, compiled)
    filming = _new_filming(to, camera, writer, cfg.task or recording[0].task or "do the task", cfg.rate)
    with _leaving(filming):
        for k, demonstration in enumerate(recording.demonstrations):
            if writer.has(k):
                continue
            motion = StateEstimator.of(model, demonstration, StateEstimatorCfg("smoothing_spline"), engine=engine)
            time = np.arange(motion.span[0], motion.span[1], 1 / cfg.rate)
            qpos = motion.states(time).qpos
            ctrl = commands(compiled, demonstration, round(time[-1] / engine.timestep) + 1)
            filming.begin([k])
            for t, now in enumerate(time):
                filming.shoot(qpos[t][None])
                filming.add(0, qpos[t][joints], ctrl[round(now / engine.timestep)])
                progress((k + (t + 1) / len(time)) / len(recording.demonstrations))
            filming.end(0, keep=True)
    return filming


def _handover(
    environment: Environment, teacher: Policy, act: PolicyFunction, filming: DatasetFilming, to: Destination
) -> Handover:
    """Return who drives in an environment whose worlds are filmed; `act` is the teacher's function there."""
    from concent_warp.deploy.handover import FilmedImages, Handover
    from concent_warp.deploy.simulated_images import simulated_images
    from concent_warp.train.distil.student import Student
    from concent_warp.train.flow.policy import FlowPolicy
    from concent_warp.train.flow.task_policy import TaskFlowPolicy

    driver = to.driver
    if isinstance(driver, FlowPolicy):
        drive = TaskFlowPolicy(driver, teacher, filming.task).act_in(environment, FilmedImages(filming))
    elif isinstance(driver, Student):
        drive = driver.act_in(environment, simulated_images(environment, driver.cfg.images, driver.cfg.looks))
    else:
        assert driver is not None
        drive = driver.act_in(environment)
    return Handover(environment, drive, act, to.cfg.handover, to.cfg.seed)


@contextmanager
def _leaving(filming: DatasetFilming) -> Iterator[None]:
    """Discard the episodes that have not ended when something goes wrong."""
    try:
        yield
    except BaseException:
        filming.leave()
        raise


def _hybrid_camera(
    cfg: RenderCfg, given: Model, worlds: int, device: str | None
) -> tuple[HybridCamera, mujoco.MjModel]:
    """Return what renders, and the scene's model with the cameras."""
    import warp as wp

    from concent_warp.model import Model
    from concent_warp.render.cameras import place_cameras
    from concent_warp.render.composite import HybridCamera
    from concent_warp.render.networks.painter import Painter
    from concent_warp.render.splats.splats import Splats
    from concent_warp.scene.cameras import with_cameras
    from concent_warp.simulate.warp_engine import preferred_device

    device = device or preferred_device()
    where = str(wp.device_to_torch(wp.get_device(device)))
    painter = None
    if cfg.networks is not None:
        options = {"steps": cfg.flow_steps, "seed": cfg.seed, "half": cfg.half}
        painter = Painter.load(cfg.networks, device=where, **options)
    names = cfg.cameras or (tuple(painter.cameras) if painter is not None else (BASE, WRIST))
    scene = given.scene
    own = [] if painter is None else [painter.cameras[name] for name in names if name in painter.cameras]
    others = [name for name in names if name not in [camera.name for camera in own]]
    spec = Model(with_cameras(scene, others), given.geometry).spec()
    place_cameras(spec, own)
    model = spec.compile()
    splats = {body: Splats.read(file, device=where) for body, file in splat_files(cfg.splats).items()}
    camera = HybridCamera(
        model, names, (cfg.size, cfg.size), worlds, objects=scene.objects(), splats=splats,
        painter=painter, shadows=cfg.lights if cfg.shadows else None, show=cfg.show, device=device, seed=cfg.seed,
    )  # fmt: skip
    return camera, model


def _task_camera(cfg: RenderCfg, task: Task, worlds: int, device: str) -> tuple[RandomisedCamera, mujoco.MjModel]:
    """Return what renders a task under random looks, and the scene's model with the cameras as they are meant."""
    from concent_warp.deploy.simulated_images import RandomisedCamera
    from concent_warp.model import Model
    from concent_warp.scene.cameras import BASE_FOVY, with_cameras
    from concent_warp.train.distil.cfg import ImagesCfg

    images = ImagesCfg(cfg.cameras or (BASE, WRIST), base_fovy=BASE_FOVY, size=cfg.size, shadows=cfg.shadows)
    camera = RandomisedCamera(task, worlds, images, cfg.looks, device)
    return camera, Model(with_cameras(task.model.scene, images.cameras), task.model.geometry).spec().compile()


def _addressed(model: mujoco.MjModel, camera: FilmCamera, rate: int) -> tuple[np.ndarray, EpisodeLayout]:
    """Return where the joints of one degree of freedom are in qpos, and the layout of a data set of them."""
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


def _dataset_writer(to: Destination, layout: EpisodeLayout, model: mujoco.MjModel) -> DatasetWriter:
    """Return the data set of cameras in a model, new or to be continued, with their calibration beside it."""
    settings = {"format": to.format, "out": str(to.out), **plain(to.cfg)}
    if to.driver is not None:
        settings["driver"] = str(to.driver.folder)
    if to.resume:
        check_unchanged(to.out / SETTINGS, settings, FREE)
    write_settings(to.out, settings)
    from concent_warp.recording.logs.readers.calibration import FILE, write_calibration
    from concent_warp.render.cameras import scene_calibration

    write_calibration(to.out / FILE, {name: scene_calibration(model, name, layout.size) for name in layout.cameras})
    if to.format == "robomimic":
        from concent_warp.render.dataset.robomimic import RobomimicWriter

        return RobomimicWriter(to.out, layout)
    from concent_warp.render.dataset.lerobot import LeRobotWriter

    return LeRobotWriter(to.out, layout, codec=to.cfg.codec)


def _new_filming(to: Destination, camera: FilmCamera, writer: DatasetWriter, task: str, rate: int) -> DatasetFilming:
    """Return what takes the frames to the data set."""
    from concent_warp.render.filming import FILMS, DatasetFilming

    films = to.out / FILMS if to.cfg.films else None
    return DatasetFilming(camera, writer, task, films=films, first_films=to.cfg.films, rate=rate)


def _draw_figure(cfg: RenderCfg, filming: DatasetFilming) -> Path | None:
    """Write the figure that is asked for, and return its path; None where no frame was rendered in this call."""
    if cfg.figure is None or not len(filming.album):
        return None
    from concent_warp.render.figure import decomposition

    make_folder(cfg.figure.parent)
    decomposition(filming.album.chosen(), filming.camera.cameras, cfg.figure)
    return cfg.figure
