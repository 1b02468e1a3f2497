"""Settings of a distillation; this module imports no heavy packages."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from concent_warp.checks import (
    Bounds,
    Count,
    Duration,
    Interval,
    OpenAngle,
    Positive,
    PositiveInterval,
    Share,
    Worlds,
    check_settings,
)
from concent_warp.documents import read_toml
from concent_warp.errors import ConcentError, TrainError
from concent_warp.events.decode import decode
from concent_warp.files import write_text
from concent_warp.run_folder import plain

DISTIL_SETTINGS = "distil.toml"
"""File of the settings of a distillation; a folder that holds one is the run folder of a student."""


@dataclass(frozen=True)
class ImagesCfg:
    """What the student sees.

    Example:
        >>> import concent_warp as cw
        >>> cw.ImagesCfg(cameras=("wrist",), size=96).delay
        (0, 2)
    """

    cameras: tuple[str, ...] = ("base", "wrist")
    """Cameras of the scene; "base" beside the objects and "wrist" on the hand are added where the scene has none."""
    base_fovy: OpenAngle = 24.0
    """Vertical field of view of the camera "base" where it is added [degrees]: so narrow that few pixels show where
    the objects are to some millimetres."""
    size: Annotated[int, Bounds(8, 1024)] = 96
    """Height and width of an image [px]."""
    frames: Annotated[int, Bounds(1, 8)] = 1
    """Successive images of a camera that the student sees at once, one control step apart."""
    delay: Annotated[tuple[int, int], Bounds(0, 20, ascending=True)] = (0, 2)
    """Least and largest delay of the images [control steps]; sampled once for each episode."""
    shadows: bool = True
    """Whether lights cast shadows in ray-traced images."""
    samples: Annotated[int, Bounds(1, 16)] = 2
    """Rays along each edge of a pixel in ray-traced images."""
    networks: str | None = None
    """Run folder of concent render-train: its networks paint robot and background in place of the ray tracer."""
    splats: tuple[str, ...] = ()
    """Gaussian splats of objects, each as body=file.ply, in metres and the body's frame."""


@dataclass(frozen=True)
class LooksCfg:
    """Random appearance of the ray-traced scene; values are sampled for each world when an episode begins, and anew
    in training.

    Example:
        >>> import concent_warp as cw
        >>> cw.LooksCfg(camera_position=0.01).camera_angle
        0.6
    """

    colour: Share = 0.25
    """Largest change of a geom's red, green and blue [-], uniform."""
    hue_share: Share = 0.35
    """Share of bodies whose colour is replaced by a random one: things seldom have the colours of their model."""
    pattern: Share = 0.8
    """Largest contrast of random patterns on surfaces [-]."""
    pattern_length: PositiveInterval = (0.004, 0.3)
    """Range of the wavelengths of the patterns, log-uniform [m]."""
    stripe_share: Share = 0.3
    """Share of patterns whose waves all run in one direction, as the grain of wood does."""
    grain_share: Share = 0.5
    """Share of surfaces that are divided into small cells of random brightness, as speckled or grained ones are."""
    grain: Share = 0.7
    """Largest contrast of these cells [-]."""
    grain_length: PositiveInterval = (0.002, 0.05)
    """Range of the edge of a cell, log-uniform [m]."""
    size: Annotated[float, Bounds(0, 0.9)] = 0.05
    """Largest relative change of the drawn size of a geom of the objects along each of its axes [-]; meshes keep
    theirs."""
    chamfer: Interval = (0.0, 0.003)
    """Range of the width of the cuts along the edges of objects that are a box or a cylinder [m]: real edges are not
    sharp, and a student of sharp ones takes cut ones for another pose."""
    lights: Annotated[int, Bounds(1, 16)] = 2
    """Lamps, in place of those of the scene; the first casts shadows."""
    light_elevation: Annotated[tuple[float, float], Bounds(0, 90, ascending=True)] = (30.0, 85.0)
    """Range of the angle of a lamp above the horizontal, seen from the objects [degrees]."""
    light_distance: PositiveInterval = (0.8, 2.0)
    """Range of the distance of a lamp from the objects [m]."""
    light_strength: Interval = (0.1, 0.9)
    """Range of the light of a lamp [-]."""
    light_tint: Share = 0.2
    """Largest relative change of red, green and blue of a lamp [-]."""
    ambient: Interval = (0.0, 0.1)
    """Range of the light of a lamp that comes from all sides [-]."""
    camera_position: Duration = 0.004
    """Largest displacement of a camera per axis [m]: twice what is left after `concent calibrate`."""
    camera_angle: Duration = 0.6
    """Largest rotation of a camera about each of its axes [degrees]; likewise. A degree at a distance of one metre
    displaces what is seen by 17 mm, more than a grasp forgives."""
    renewed: Share = 0.05
    """Share of the worlds whose looks are sampled anew in each step of the training, besides those in which an episode
    begins: more looks are learned from than there are episodes. None with several successive images."""


@dataclass(frozen=True)
class AugmentCfg:
    """Random changes of the images in training, of each camera and sample anew.

    Example:
        >>> import concent_warp as cw
        >>> cw.AugmentCfg(shift=4).shift
        4
    """

    shift: Annotated[int, Bounds(0, 64)] = 0
    """Largest shift of an image along each axis [px]; none, since a shifted image shows everything elsewhere."""
    brightness: Share = 0.35
    """Largest relative change of the brightness [-]."""
    contrast: Share = 0.25
    """Largest relative change of the contrast [-]."""
    balance: Share = 0.2
    """Largest relative change of each of red, green and blue [-]."""
    gamma: PositiveInterval = (0.75, 1.3)
    """Exponent of the tone curve [-]."""
    vignette: Share = 0.3
    """Largest share of the light that the corners lose [-]."""
    noise: Share = 0.02
    """Largest standard deviation of the colours' noise [-]."""
    blur: Share = 0.3
    """Share of images that are blurred by a Gaussian of one pixel."""


@dataclass(frozen=True)
class StudentNetworkCfg:
    """The student's network: a residual network for each camera, and a multi-layer perceptron.

    Example:
        >>> import concent_warp as cw
        >>> cw.StudentNetworkCfg(blind=True).blind
        True
    """

    channels: tuple[Annotated[int, Bounds(8, 4096)], ...] = (32, 64, 128)
    """Channels of the stages, multiples of 8; each stage halves the resolution."""
    blocks: Annotated[int, Bounds(0, 64)] = 2
    """Residual blocks of each stage but the first."""
    keypoints: Annotated[int, Bounds(1, 4096)] = 32
    """Channels whose spatial softmax is taken: each is a position in the image."""
    hidden: tuple[Annotated[int, Bounds(1, 100_000)], ...] = (1024, 512)
    """Sizes of the hidden layers of the perceptron."""
    blind: bool = False
    """Show the student black images: a control."""


@dataclass(frozen=True)
class DaggerCfg:
    """DAgger (Ross et al., AISTATS 2011); the share of episodes that the teacher drives falls to `beta_end`.

    Example:
        >>> import concent_warp as cw
        >>> cw.DaggerCfg(beta=1.0, beta_end=1.0).beta_end  # cloning without DAgger
        1.0
    """

    iterations: Count = 1100
    """Iterations of collecting samples and updating the student."""
    worlds: Worlds = 2048
    """Number of environments simulated in parallel, on each rank."""
    steps: Annotated[int, Bounds(1, 100_000)] = 4
    """Steps of each environment per iteration."""
    updates: Annotated[int, Bounds(1, 1_000_000)] = 16
    """Gradient steps per iteration."""
    batch: Annotated[int, Bounds(1, 1_000_000)] = 1024
    """Samples of a gradient step, on each rank."""
    buffer: Count = 600_000
    """Latest samples that are kept to learn from, on each rank."""
    beta: Share = 1.0
    """Share of episodes that the teacher drives, at first."""
    beta_end: Share = 0.0
    """The same from `beta_iterations` on; 1 clones the teacher's behaviour without DAgger."""
    beta_iterations: Annotated[int, Bounds(0, 10_000_000)] = 100
    """Iterations in which the share falls linearly."""
    label: Literal["truth", "observed"] = "truth"
    """What the teacher observes when it labels: the true state, or the one that it was trained to observe, with sensor
    errors."""
    learning_rate: Annotated[float, Bounds(0, 1, above_low=True)] = 1e-3
    """Largest learning rate of AdamW [-]; it falls to nearly 0 along half a cosine."""
    warm_up: Annotated[int, Bounds(0, 10_000_000)] = 100
    """Gradient steps in which the learning rate rises."""
    decay: Share = 1e-4
    """Weight decay [-]."""
    auxiliary: Share = 0.5
    """Weight of the loss on the predicted poses of the objects [-]."""
    normalise_iterations: Count = 50
    """Iterations in which mean and standard deviation of the proprioception are estimated."""
    gradient: Positive = 1.0
    """Largest norm of the gradient [-]."""
    half: bool = True
    """Whether the network computes in bfloat16 on a GPU."""
    compiled: bool = True
    """Whether the network is compiled by torch.compile on a GPU: learning takes half the time, after half a minute of
    compilation. Without a compiler (Triton, C) it is not."""


@dataclass(frozen=True)
class DistilCfg:
    """Settings of a distillation.

    Example:
        >>> import concent_warp as cw
        >>> cw.DistilCfg(images=cw.ImagesCfg(size=96)).images.cameras
        ('base', 'wrist')
    """

    method: Literal["dagger", "rsl_rl"] = "dagger"
    """DAgger, or rsl-rl's own distillation as a baseline: the student drives from the start, and what was seen is
    learned from once."""
    seed: int = 0
    """Seed of all random numbers."""
    checkpoint: Positive = 600.0
    """Time between checkpoints [s], at least ten times that of writing one; one is also written at the end and on
    interruption."""
    states: Count | None = None
    """Initial states of the episodes; as many as in the teacher's training by default."""
    free: Share = 0.5
    """In chains of stages, share of the initial states at the start of the whole task, as `ResetCfg.free`: there a
    student begins, and the objects are anywhere."""
    tolerance: Positive = 0.01
    """In chains of stages, least distance of contact pairs at which a stage ends [m], as `ChainCfg.tolerance`: a
    student does not observe the stage, and a teacher that waits for a grasp as exact as its own gives the same images
    two labels."""
    physics: Literal["training", "stress"] = "stress"
    """Physics in which the student learns: the teacher's training's, or that of its stress test, in which edges catch
    and steps are shorter (`StressCfg.refine`). In the former a block that is some millimetres beside its hole slides
    in, and its students stop at the rim in Reality."""
    dagger: DaggerCfg = field(default_factory=DaggerCfg)
    """The training."""
    images: ImagesCfg = field(default_factory=ImagesCfg)
    """Images."""
    looks: LooksCfg = field(default_factory=LooksCfg)
    """Random appearance."""
    augment: AugmentCfg = field(default_factory=AugmentCfg)
    """Changes of the images."""
    network: StudentNetworkCfg = field(default_factory=StudentNetworkCfg)
    """The student's network."""

    def __post_init__(self) -> None:
        check_settings(self, TrainError)
        images, network = self.images, self.network
        if not images.cameras or len(set(images.cameras)) != len(images.cameras):
            raise TrainError("the cameras are not right", expected="at least one, each once", found=images.cameras)
        if not network.channels or any(width % 8 for width in network.channels):
            raise TrainError("network.channels is not right", expected="multiples of 8", found=network.channels)
        if not network.hidden:
            raise TrainError("network.hidden is empty", expected="at least one layer")

    def save(self, path: Path) -> None:
        """Write a TOML file atomically; None values are left out."""
        import tomli_w

        write_text(path, tomli_w.dumps(plain(self)))

    @staticmethod
    def load(path: Path) -> DistilCfg:
        """Return the settings that `save` wrote.

        Raises:
            TrainError: The file is missing or not a configuration of a distillation.
        """
        if not path.is_file():
            raise TrainError("the folder holds no student", where=path.parent, expected=f"a {DISTIL_SETTINGS}")
        try:
            return decode(DistilCfg, read_toml(path, TrainError), str(path))
        except TrainError:
            raise
        except ConcentError as error:
            raise TrainError(str(error)) from None


def holds_student(path: Path) -> bool:
    """Return whether a folder, or the folder of a checkpoint file, is the run folder of a student."""
    return ((path if path.is_dir() else path.parent) / DISTIL_SETTINGS).is_file()
