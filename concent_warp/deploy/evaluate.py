"""Success rate of a policy in simulation and in Reality, from initial states that training has not seen."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from concent_warp.checks import check_device
from concent_warp.deploy.cfg import EvaluateCfg, TrialName, check_evaluation
from concent_warp.deploy.reality_world import reality_environment, reality_world
from concent_warp.deploy.record_trials import TrialRecorder
from concent_warp.files import all_or_none
from concent_warp.reality.hidden.in_task import TaskWorld
from concent_warp.reality.sensors.live_cameras import LiveCamerasCfg
from concent_warp.reality.sensors.video import render_video, write_video
from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.run_folder import claim_file, make_folder
from concent_warp.scene.cameras import BASE_FOVY
from concent_warp.train.distil.cfg import ImagesCfg
from concent_warp.train.distil.student import Student
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.state_estimate import check_biased
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.flow.task_policy import TaskFlowPolicy
from concent_warp.train.policy.load import Policy
from concent_warp.train.resets.reset_states import ResetStates
from concent_warp.train.task.task import Task
from concent_warp.train.trials.episodes import PolicyFunction
from concent_warp.train.trials.evaluate import Evaluation, Watch, run_episodes

TRIALS = "trials.h5"
"""Recording of the trials, in the folder that is asked for."""


def evaluate(
    policy: Policy | Student | TaskFlowPolicy,
    cfg: EvaluateCfg | None = None,
    *,
    world: TrialName = "reality",
    episodes: int = 200,
    seed: int = 0,
    device: str | None = None,
    out: str | Path | None = None,
    record: str | Path | None = None,
    overwrite: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Evaluation:
    """Return the outcomes of a policy's episodes from many initial states.

    A student acts by images: in simulation by those of the task's scene under random looks, in Reality by those of
    Reality's own cameras. So does a flow policy, in simulation by images like those that `render` writes.

    Args:
        policy: The policy, which observes the state, a student, which sees, or a flow policy in a task.
        cfg: Settings: Reality with its hidden effects, the scales of the robot's commands, videos.
        world: "simulation", the model that the policy was trained in; "stress", the same model under the worse
            conditions of `StressCfg`; or "reality": exact convex shapes, friction, masses and gains that nobody knows,
            shorter time steps, and the effects of `EvaluateCfg.hide`.
        episodes: Number of initial states; one episode starts from each.
        seed: Seed of the initial states.
        device: Warp's name of the device for the simulation; the first CUDA device by default, the CPU
            without one.
        out: Folder of the videos; by default the folder `videos` in the policy's run folder, or in the working
            directory for a pretrained policy.
        record: Folder for the recording ``trials.h5`` of the trials in Reality, for `explain`.
        overwrite: Replace existing videos and recordings.
        progress: Called with the share done, 0..1.

    Raises:
        TrainError: A setting is out of bounds, or Reality has other bodies than the model.
        ConcentError: A hidden effect is unknown, or a video exists.

    Example:
        >>> import concent_warp as cw
        >>> result = cw.evaluate(cw.load_policy("shape_sorter"), world="simulation", episodes=2, device="cpu")
        >>> result.rate
        1.0
    """
    cfg = cfg or EvaluateCfg()
    check_evaluation(cfg, world, episodes, seed, record=record is not None)
    check_device(device)
    if record is not None:
        claim_file(Path(record) / TRIALS, overwrite=overwrite)
    default = Path("videos") if policy.pretrained else policy.folder / "videos"
    videos = _video_files(cfg, default if out is None else Path(out), overwrite=overwrite)
    policy = policy.scaled(cfg.action_scale, cfg.setpoint_lead_scale)
    run = policy.run
    check_biased(cfg.sensors, run.model.scene.objects())
    if world == "stress":
        test = run.stress_test(device=device, episodes=episodes, seed=seed)
        torch.manual_seed(seed)
        return test(_act_in(policy, test.environment), progress)
    task = run.task()
    states = run.evaluation_states(task, episodes, seed)
    settings = replace(run.cfg.environment, worlds=min(episodes, run.cfg.environment.worlds))
    while True:
        torch.manual_seed(seed)
        if world == "reality":
            environment = reality_environment(task, settings, states, cfg, seed=seed)
        else:
            environment = make_environment(task, settings, states, device=device)
        states_seen = EpisodeStates(len(videos))
        real = reality_world(task, settings, cfg) if world == "reality" else None
        act = _act_in(policy, environment, real, cfg.cameras, seed=seed, device=device)
        environment.read_log()
        watches: list[Watch] = [states_seen]
        recorder = None if record is None else TrialRecorder(run, environment, cfg.sensors)
        if recorder is not None:
            act, watches = recorder.acting(act), [states_seen, recorder]
        found = run_episodes(environment, act, states, progress=progress, watch=_all(watches))
        share, buffers = environment.read_log()["overflow"], environment.buffers
        if share:
            repeated = "the scene needs more memory (<size memory>)" if buffers is None else "the episodes are repeated"
            warnings.warn(f"contacts were dropped in {share:.2%} of the steps: {repeated}", stacklevel=2)
        if not share or buffers is None:
            break
        settings = replace(settings, nconmax=2 * buffers[0], njmax=2 * buffers[1])
    recorded = _write_trials(Path(record) / TRIALS, recorder, found, cfg) if record and recorder else None
    if videos:
        _write_videos(videos, states_seen, reality_world(task, settings, cfg), task, states, environment.control_step)
    return replace(found, videos=tuple(videos), recorded=recorded)


def _all(watches: Sequence[Watch]) -> Watch:
    """Return a watch that calls several ones."""

    def watch(episodes: np.ndarray, qpos: np.ndarray) -> None:
        for one in watches:
            one(episodes, qpos)

    return watch


def _write_trials(path: Path, recorder: TrialRecorder, found: Evaluation, cfg: EvaluateCfg) -> Path | None:
    """Write the recording of the trials that are asked for, and return its path; None where there are none."""
    chosen = [k for k in range(len(found.success)) if not (cfg.record_failures and found.success[k])]
    if not chosen:
        return None
    make_folder(path.parent)
    write_hdf5(recorder.recording(found, chosen), path)
    return path


def _act_in(
    policy: Policy | Student | TaskFlowPolicy,
    environment: Environment,
    real: TaskWorld | None = None,
    cameras: LiveCamerasCfg | None = None,
    *,
    seed: int = 0,
    device: str | None = None,
) -> PolicyFunction:
    """Return the function from an environment's observations to actions; `real` is given in Reality."""
    if isinstance(policy, Policy):
        return policy.act_in(environment)
    from concent_warp.deploy.reality_images import RealityImages
    from concent_warp.deploy.simulated_images import HybridImages, simulated_images
    from concent_warp.simulate.warp_engine import preferred_device

    where = preferred_device() if device is None else device
    if isinstance(policy, TaskFlowPolicy):
        features = policy.policy.features
        images = ImagesCfg(features.cameras, base_fovy=BASE_FOVY, size=max(features.size))
        if real is None:
            source = HybridImages(environment, images)
        else:
            live = cameras or LiveCamerasCfg()
            source = RealityImages(environment, real.spec(), images, live, seed=seed, device=where)
        act = policy.act_in(environment, source)
        torch.manual_seed(seed)
        return act
    images = policy.cfg.images
    if real is None:
        act = policy.act_in(environment, simulated_images(environment, images, policy.cfg.looks))
    else:
        source = RealityImages(environment, real.spec(), images, cameras or LiveCamerasCfg(), seed=seed, device=where)
        act = policy.act_in(environment, source, delay=(0, 0))
    torch.manual_seed(seed)
    return act


def _video_files(cfg: EvaluateCfg, folder: Path, *, overwrite: bool) -> list[Path]:
    """Return the files of the requested videos.

    Raises:
        ConcentError: One of them exists and is not to be replaced.
    """
    hidden = "".join(f"_{one}" for one in cfg.hide)
    files = [folder / f"reality{hidden}_{k:03d}.mp4" for k in range(cfg.videos)]
    for file in files:
        claim_file(file, overwrite=overwrite)
    return files


class EpisodeStates:
    """Collects the positions along the first episodes of an evaluation; a `watch` of `run_episodes`."""

    def __init__(self, count: int) -> None:
        self.states: list[list[np.ndarray]] = [[] for _ in range(count)]
        """Positions (nq,) before each step of each episode."""

    def __call__(self, episodes: np.ndarray, qpos: np.ndarray) -> None:
        """Store positions (R, nq) of the episodes (R,)."""
        for episode, state in zip(episodes, qpos, strict=True):
            if episode < len(self.states):
                self.states[episode].append(state.copy())


def _write_videos(
    files: list[Path], episodes: EpisodeStates, world: TaskWorld, task: Task, starts: ResetStates, period: float
) -> None:
    """Write videos of episodes from the initial states `starts`; `period` is the time between states [s]."""
    bodies = tuple(task.compiled.body(i).name for i in task.objects)
    with all_or_none():
        for k, (path, states) in enumerate(zip(files, episodes.states, strict=True)):
            make_folder(path.parent)
            spec = world.spec()
            for body in task.objects:
                mocap = int(task.compiled.body_mocapid[body])
                if mocap >= 0:
                    placed = spec.body(task.compiled.body(body).name)
                    placed.pos, placed.quat = starts.mocap[k, mocap, :3], starts.mocap[k, mocap, 3:]
            write_video(path, render_video(spec, bodies, np.array(states), period), 1 / period)


def without_reality(cfg: EvaluateCfg) -> EvaluateCfg:
    """Return the settings without hidden effects and videos, for an evaluation in simulation."""
    return replace(cfg, hide=(), videos=0, record_failures=False)
