"""Settings of evaluation, live view and rendering; this module imports no heavy packages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from concent_warp.checks import Bounds, Count, PositiveShare, Signed, Worlds, check_seed, check_settings
from concent_warp.errors import RenderError, TrainError
from concent_warp.reality.hidden.in_task import parse_effects
from concent_warp.reality.sensors.live_cameras import LiveCamerasCfg
from concent_warp.reality.variation import VariationCfg
from concent_warp.reality.world import WorldCfg
from concent_warp.render.shadow_cfg import ShadowCfg
from concent_warp.scene.shape_sorter import ShapeSorterCfg
from concent_warp.train.distil.cfg import LooksCfg
from concent_warp.train.observation_cfg import SensorErrorsCfg

WorldName = Literal["simulation", "reality"]
TrialName = Literal["simulation", "stress", "reality"]
"""Worlds of an evaluation: "stress" is the stress test."""
Format = Literal["lerobot", "robomimic"]


@dataclass(frozen=True)
class RealityWorldCfg:
    """Reality, the world in which a policy is evaluated.

    By default nobody knows its friction, masses and gains, and the policy sees encoder readings and tracked poses.
    """

    hide: tuple[str, ...] = ()
    """Hidden effects, each as name=value in the unit of its main parameter, such as joint_friction=1.2; an unknown name
    lists the known ones."""
    shapes: ShapeSorterCfg = field(default_factory=ShapeSorterCfg)
    """Sizes of block and hole."""
    reality: WorldCfg = field(default_factory=lambda: WorldCfg(timestep=5e-4, integrator="Euler"))
    """Physics: time step and integrator, other than the model's, chamfers, contact stiffness."""
    variation: VariationCfg = field(default_factory=VariationCfg)
    """Friction, masses and gains, sampled for each world."""
    sensors: SensorErrorsCfg = field(default_factory=SensorErrorsCfg)
    """Errors of the instruments that the policy observes through."""


@dataclass(frozen=True)
class EvaluateCfg(RealityWorldCfg):
    """Settings of an evaluation.

    Example:
        >>> import concent_warp as cw
        >>> cfg = cw.EvaluateCfg(hide=("joint_friction=1.2",))
        >>> cw.evaluate(cw.load_policy("shape_sorter"), cfg, world="reality", episodes=1).success.shape
        (1,)
    """

    action_scale: PositiveShare = 1.0
    """Size of command steps relative to training, above 0 and at most 1: below 1 the robot moves more slowly; episodes
    last as long."""
    setpoint_lead_scale: PositiveShare = 1.0
    """Largest difference of command and joint position relative to training, above 0 and at most 1: with the stiffness
    of the drives it bounds the force that the robot exerts."""
    videos: int = 0
    """Number of first episodes in Reality to record as MP4."""
    record_failures: bool = False
    """Whether only failed trials are recorded."""
    cameras: LiveCamerasCfg = field(default_factory=LiveCamerasCfg)
    """Reality's cameras, by which a student acts."""


@dataclass(frozen=True)
class PlayCfg(RealityWorldCfg):
    """Settings of the live view.

    Example:
        >>> import concent_warp as cw
        >>> cw.PlayCfg(port=8090, states=4).port
        8090
    """

    action_scale: PositiveShare = 1.0
    """Size of command steps relative to training, above 0 and at most 1."""
    setpoint_lead_scale: PositiveShare = 1.0
    """Largest difference of command and joint position relative to training, above 0 and at most 1."""
    port: Annotated[int, Bounds(0, 65535)] = 8080
    """Port of the page; if it is in use, the next free one."""
    host: str = "127.0.0.1"
    """Address of the server; 0.0.0.0 lets anyone in the network open the page and use its controls."""
    speed: Annotated[float, Bounds(0.1, 4)] = 1.0
    """Initial speed relative to simulated time."""
    states: Annotated[int, Bounds(1, 10_000)] = 32
    """Number of initial states, from which episodes start in turn."""
    pause: Annotated[float, Bounds(0, 3600)] = 1.0
    """Time for which the last state of an episode is shown, at normal speed [s]."""
    poll: Annotated[float, Bounds(0.001, 60)] = 0.2
    """Period of polling the controls while the policy is paused [s]."""
    eye: tuple[Signed, Signed, Signed] = (0.3, -0.42, 0.36)
    """Position of the camera relative to the objects [m]."""
    touch_gap: float = 5e-4
    """Gap below which a sphere is shown as touching a body [m], the depth of typical contacts."""


@dataclass(frozen=True)
class HandoverCfg:
    """When a policy hands over to the one whose episodes are rendered, and what of it goes into the data set.

    Example:
        >>> import concent_warp as cw
        >>> cw.RenderCfg(handover=cw.HandoverCfg(time=(0.5, 2.0))).handover.frames
        'teacher'
    """

    time: Annotated[tuple[float, float], Bounds(0, 3600, ascending=True)] = (0.0, 1.5)
    """Least and largest time for which the first policy drives [s], uniform; episodes last as much longer."""
    frames: Literal["teacher", "all", "labelled"] = "teacher"
    """Frames that go into the data set: those from the hand-over on; all, though what the first policy did is no
    example to follow; or all, those of the first policy with what the other one would do from there on."""
    chunk: Annotated[int, Bounds(1, 1000)] = 16
    """Commands of such a label, found by branching the worlds; a flow policy learns as many of them as its chunks
    have."""


@dataclass(frozen=True)
class RenderCfg:
    """Settings of rendering.

    Example:
        >>> import concent_warp as cw
        >>> cw.RenderCfg(episodes=5, size=64, cameras=("base",)).size
        64
    """

    episodes: Count = 20
    """Initial states of the policy, one episode from each."""
    keep: Literal["successes", "all"] = "successes"
    """Which episodes of a policy go into the data set."""
    task: str | None = None
    """Description of the task in words; the demonstration's by default."""
    networks: Path | None = None
    """Run folder of concent render-train; its cameras are rendered."""
    splats: tuple[str, ...] = ()
    """Gaussian splats of objects, each as body=file.ply, in metres and the body's frame."""
    shadows: bool = True
    """Whether objects with splats cast shadows, under lights sampled for each episode."""
    cameras: tuple[str, ...] = ()
    """Cameras to render; by default those of the networks, without networks "base" and "wrist", added if absent."""
    size: Annotated[int, Bounds(1, 4096)] = 256
    """Height and width of the images [px]."""
    show: Literal["visual", "spheres"] = "visual"
    """Geometry of the objects in the raw image: visual shapes or contact spheres."""
    randomise: bool = False
    """Ray-trace each episode of a policy under random looks; without networks and splats."""
    rate: Annotated[int, Bounds(1, 1000)] = 10
    """Frame rate of a rendered recording [Hz]; a policy's episodes have its control rate."""
    worlds: Worlds = 8
    """Number of episodes rendered in parallel."""
    flow_steps: Annotated[int, Bounds(1, 10_000)] = 4
    """Steps of the flow from noise to image; fewer are faster."""
    half: bool = False
    """Evaluate the networks in bfloat16, which is faster on a GPU."""
    codec: Literal["h264", "av1"] = "h264"
    """Video codec of a LeRobotDataset."""
    films: int = 0
    """Number of first episodes to also write as MP4, with the cameras side by side."""
    figure: Path | None = None
    """File (.png or .pdf) of a figure with the layers of the first episode's images."""
    seed: int = 0
    """Seed of initial states, lights and noise."""
    lights: ShadowCfg = field(default_factory=ShadowCfg)
    """Settings of the lights."""
    looks: LooksCfg = field(default_factory=LooksCfg)
    """Random looks, as those of a distillation; used with `randomise`."""
    handover: HandoverCfg = field(default_factory=HandoverCfg)
    """Settings of the hand-over from another policy, where one is given."""


def check_evaluation(cfg: EvaluateCfg, world: TrialName, episodes: int, seed: int = 0, *, record: bool = False) -> None:
    """Check the settings of an evaluation; `record` says whether its trials are to be recorded.

    Raises:
        TrainError: One is out of bounds, or concerns Reality while the policy runs in simulation.
    """
    check_settings(cfg, TrainError)
    check_seed(seed, TrainError)
    if episodes < 1:
        raise TrainError("the number of episodes is out of bounds", expected="at least 1", found=episodes)
    if not 0 <= cfg.videos <= episodes:
        raise TrainError("the number of videos is out of bounds", expected=f"0 to {episodes}", found=cfg.videos)
    if parse_effects(cfg.hide) and world != "reality":
        raise TrainError("hidden effects exist only in Reality", fix="add --world reality")
    if cfg.videos and world != "reality":
        raise TrainError("videos are of Reality", fix="add --world reality")
    if record and world != "reality":
        raise TrainError("trials are recorded in Reality", fix="add --world reality")


def splat_files(texts: Sequence[str]) -> dict[str, Path]:
    """Return the files of Gaussian splats by body, each given as body=file.ply.

    Raises:
        RenderError: One is given otherwise.
    """
    found = {}
    for text in texts:
        body, _, file = text.partition("=")
        if not file:
            raise RenderError("splats are given as body=file.ply", found=repr(text))
        found[body] = Path(file)
    return found
