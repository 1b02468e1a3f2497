"""Settings of evaluation, live view and rendering; imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from concent_warp.errors import TrainError
from concent_warp.reality.hidden.in_task import wanted
from concent_warp.reality.world import WorldCfg
from concent_warp.render.shadow_cfg import ShadowCfg
from concent_warp.scene.shape_sorter import ShapeSorterCfg

WorldName = Literal["simulation", "reality"]
Format = Literal["lerobot", "robomimic"]


@dataclass(frozen=True)
class RealityWorldCfg:
    """Reality in which a policy is tried."""

    hide: tuple[str, ...] = ()
    """Hidden effects, each as name=value in the unit of its main parameter, as in joint_friction=1.2; an unknown name
    lists those that there are."""
    shapes: ShapeSorterCfg = field(default_factory=ShapeSorterCfg)
    """Sizes of block and hole."""
    reality: WorldCfg = field(default_factory=WorldCfg)
    """Physics: time step, chamfers, contact stiffness."""


@dataclass(frozen=True)
class EvaluateCfg(RealityWorldCfg):
    """Settings of an evaluation.

    Example:
        >>> import concent_warp as cw
        >>> cfg = cw.EvaluateCfg(hide=("joint_friction=1.2",))
        >>> cw.evaluate(cw.load_policy("shape_sorter"), cfg, world="reality", episodes=1).success.shape
        (1,)
    """

    action_scale: float = 1.0
    """Size of the steps of the robot's commands, as a share of those that the policy was trained with: below 1 it moves
    more slowly, for as long an episode."""
    setpoint_lead_scale: float = 1.0
    """How far commands may run ahead of the joints, as a share of that in training: with the stiffness of the drives,
    this is the largest force that the robot exerts."""
    videos: int = 0
    """How many of the first episodes in Reality to film, as MP4."""


@dataclass(frozen=True)
class PlayCfg(RealityWorldCfg):
    """Settings of the live view.

    Example:
        >>> import concent_warp as cw
        >>> cw.PlayCfg(port=8090, states=4).port
        8090
    """

    action_scale: float = 1.0
    """Size of the steps of the robot's commands, as for concent evaluate."""
    setpoint_lead_scale: float = 1.0
    """How far commands may run ahead of the joints, as for concent evaluate."""
    port: int = 8080
    """Port of the page; the next free one where it is taken."""
    host: str = "127.0.0.1"
    """Address to serve the page on; 0.0.0.0 lets others open it, whom nothing keeps from using the controls."""
    speed: float = 1.0
    """Speed to begin with, relative to the time in the world."""
    states: int = 32
    """Initial states that episodes begin from in turn."""
    pause: float = 1.0
    """How long the last moment of an episode stays, at normal speed [s]."""
    poll: float = 0.2
    """Time between looks at the controls while nothing moves [s]."""
    eye: tuple[float, float, float] = (0.3, -0.42, 0.36)
    """Where the objects are seen from, relative to them [m]."""


@dataclass(frozen=True)
class RenderCfg:
    """Settings of rendering.

    Example:
        >>> import concent_warp as cw
        >>> cw.RenderCfg(episodes=5, size=64, cameras=("base",)).size
        64
    """

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
    """Whether objects with splats cast shadows, under lights sampled for each episode."""
    cameras: tuple[str, ...] = ()
    """Cameras to render; by default those of the networks, else base and wrist, which a scene without any is given."""
    size: int = 256
    """Height and width of the images [px]."""
    show: Literal["visual", "spheres"] = "visual"
    """What the raw image shows of the objects: their shapes, or the contact spheres."""
    rate: int = 10
    """Frames a second of a recording; those of a policy come at its own rate."""
    worlds: int = 8
    """Episodes rendered at a time."""
    flow_steps: int = 4
    """Steps of the flow from noise to image; fewer are faster."""
    half: bool = False
    """Let the networks multiply in bfloat16, which is faster on a GPU."""
    codec: Literal["h264", "av1"] = "h264"
    """How the videos of a LeRobotDataset are encoded."""
    films: int = 0
    """How many of the first episodes to write as MP4 too, the cameras side by side."""
    figure: Path | None = None
    """File (.png or .pdf) for a figure of the layers that the first episode's images are made of."""
    seed: int = 0
    """Seed of initial states, lights and noise."""
    lights: ShadowCfg = field(default_factory=ShadowCfg)
    """Lights of the shadows."""


def check(cfg: EvaluateCfg, world: WorldName, episodes: int) -> None:
    """Check the settings of an evaluation.

    Raises:
        TrainError: One of them is out of bounds, or is about Reality where the policy runs in simulation.
    """
    if episodes < 1:
        raise TrainError("the number of episodes is out of bounds", expected="at least 1", found=episodes)
    if not 0 <= cfg.videos <= episodes:
        raise TrainError("the number of videos is out of bounds", expected=f"0 to {episodes}", found=cfg.videos)
    if wanted(cfg.hide) and world == "simulation":
        raise TrainError("effects are hidden in Reality alone", fix="add --world reality")
    if cfg.videos and world == "simulation":
        raise TrainError("videos are of Reality", fix="add --world reality")
