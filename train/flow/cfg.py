"""Settings of a flow policy and of its training; this module imports no heavy packages."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from concent_warp.checks import Bounds, Count, Pixels, Positive, Share, SmallShare, check_settings
from concent_warp.errors import TrainError
from concent_warp.train.distil.cfg import AugmentCfg

Backbone = Literal["small", "florence2"]
SIZES: dict[str, int] = {"small": 96, "florence2": 224}
"""Edge of the images by backbone [px]."""
LEARNING_RATES: dict[str, float] = {"small": 3e-4, "florence2": 2e-5}
"""Largest learning rate by backbone; that of Florence-2 is FLOWER's."""
FLOW_SETTINGS = "flow.toml"
"""File of the settings of a training; a folder that holds one is the run folder of a flow policy."""
CELL = 32
"""Edge of the square that Florence-2's image encoder makes one token of [px]."""


@dataclass(frozen=True)
class SmallBackboneCfg:
    """Encoder of images and text that is trained from random weights.

    Example:
        >>> import concent_warp as cw
        >>> cw.FlowPolicyCfg(small=cw.SmallBackboneCfg(channels=(32, 64, 128))).small.text_layers
        2
    """

    channels: tuple[Annotated[int, Bounds(1, 16_384)], ...] = (32, 64, 128, 256)
    """Channels of the convolutions; each level halves the image, and the pixels of the last are its tokens."""
    text_layers: Annotated[int, Bounds(0, 1000)] = 2
    """Transformer layers over the bytes of the text."""
    fusion_layers: Annotated[int, Bounds(0, 1000)] = 2
    """Transformer layers over the tokens of images and text together."""
    text_bytes: Annotated[int, Bounds(1, 100_000)] = 256
    """Longest text [bytes]."""


@dataclass(frozen=True)
class FlowPolicyCfg:
    """Inputs and sizes of a flow policy.

    Example:
        >>> import concent_warp as cw
        >>> cw.FlowPolicyCfg(chunk=32, execute=16).edge
        96
    """

    backbone: Backbone = "small"
    """Encoder of images and text: "small" starts from random weights; "florence2" is the encoder of Florence-2, with
    the user's weights."""
    weights: Path | None = None
    """Folder with Florence-2 in the format of transformers (config.json, model.safetensors, tokenizer.json), such as a
    copy of florence-community/Florence-2-large; nothing is downloaded."""
    size: Pixels | None = None
    """Height and width to which images are resized [px]; by default 96, or 224 for Florence-2."""
    chunk: Annotated[int, Bounds(1, 10_000)] = 16
    """Actions that are predicted at once."""
    execute: Annotated[int, Bounds(1, 10_000)] = 8
    """Actions of a chunk that are executed before the next one is predicted."""
    euler_steps: Annotated[int, Bounds(1, 10_000)] = 4
    """Euler steps from noise to a chunk."""
    width: Annotated[int, Bounds(8, 16_384)] = 384
    """Channels of the transformer, a multiple of twice the heads."""
    layers: Annotated[int, Bounds(1, 1000)] = 6
    """Layers of the transformer."""
    heads: Annotated[int, Bounds(1, 1000)] = 6
    """Attention heads."""
    causal: bool = True
    """Whether an action of a chunk depends on earlier ones only, as in FLOWER."""
    proprioception: bool = True
    """Whether the state of the robot is an input; FLOWER's own single-arm policies do without."""
    small: SmallBackboneCfg = field(default_factory=SmallBackboneCfg)
    """Sizes of the backbone "small"."""

    @property
    def edge(self) -> int:
        """Height and width of the images [px]."""
        return SIZES[self.backbone] if self.size is None else self.size


@dataclass(frozen=True)
class FlowDataCfg:
    """Which features of a LeRobot data set a flow policy learns from.

    Example:
        >>> import concent_warp as cw
        >>> cw.TrainFlowCfg(data=cw.FlowDataCfg(cameras=("wrist",), validation=0.1)).data.cameras
        ('wrist',)
    """

    cameras: tuple[str, ...] = ()
    """Features of images, with or without "observation.images."; all colour images by default."""
    state: tuple[str, ...] = ()
    """Features of numbers that are the proprioception; by default "observation.state", else all "observation.*"."""
    action: tuple[str, ...] = ()
    """Features of numbers that are the action; by default "action", else all "action.*"."""
    labels: bool = True
    """Whether a chunk is what a teacher would have done from its frame on, where the data set has that (feature
    "teacher_chunk"); else it is always what happened next."""
    validation: SmallShare = 0.05
    """Share of the episodes that is kept for validation, at least one; none where there is but one episode, or at 0."""


@dataclass(frozen=True)
class TrainFlowCfg:
    """Settings of the training of a flow policy.

    Example:
        >>> import concent_warp as cw
        >>> cw.TrainFlowCfg(steps=5_000, policy=cw.FlowPolicyCfg(chunk=10)).policy.chunk
        10
    """

    seed: int = 0
    """Seed of all random numbers."""
    steps: Count = 20_000
    """Steps of the optimiser."""
    batch: Annotated[int, Bounds(1, 100_000)] = 128
    """Samples of a step."""
    learning_rate: Annotated[float, Bounds(0, 1, above_low=True)] | None = None
    """Largest learning rate, after the warm-up; it falls to a tenth along a cosine. By default 3e-4, or 2e-5 for
    Florence-2."""
    warm_up: int = 500
    """Steps in which the learning rate rises."""
    weight_decay: Share = 0.01
    """Weight decay of AdamW (Loshchilov and Hutter 2019)."""
    gradient: Positive = 1.0
    """Largest norm of the gradient [-]."""
    ema: SmallShare = 0.999
    """Share of the running mean of the weights that a step keeps; fewer in the first steps."""
    blank_state: SmallShare = 0.1
    """Share of the samples whose proprioception is hidden, so that the policy does not rely on it alone."""
    validate: Count = 500
    """Steps between validations; one is also made at the end."""
    validation_samples: Annotated[int, Bounds(1, 1_000_000)] = 1024
    """Samples of a validation, always the same ones, spread over its episodes."""
    checkpoint: float = 60.0
    """Time between checkpoints [s]; one is also written at the end and on interruption."""
    half: bool = True
    """Multiply in bfloat16 on a GPU, which is faster."""
    device_share: Share = 0.4
    """Share of a GPU's free memory that images may take; those of larger data sets stay on the disk."""
    data: FlowDataCfg = field(default_factory=FlowDataCfg)
    """Features of the data set."""
    augment: AugmentCfg = field(default_factory=AugmentCfg)
    """Random changes of the images, as in a distillation."""
    policy: FlowPolicyCfg = field(default_factory=FlowPolicyCfg)
    """Inputs and sizes of the policy."""

    @property
    def peak(self) -> float:
        """Largest learning rate."""
        return LEARNING_RATES[self.policy.backbone] if self.learning_rate is None else self.learning_rate


def check_policy_cfg(cfg: FlowPolicyCfg) -> None:
    """Check the settings of a flow policy.

    Raises:
        TrainError: A setting is out of bounds or contradicts another one.
    """
    check_settings(cfg, TrainError)
    if cfg.execute > cfg.chunk:
        raise TrainError("more actions are executed than predicted", expected=f"at most {cfg.chunk}", found=cfg.execute)
    if cfg.width % (2 * cfg.heads):
        raise TrainError(
            "the width of the transformer does not fit its heads",
            expected=f"a multiple of {2 * cfg.heads}, twice the heads",
            found=cfg.width,
        )
    if cfg.backbone == "florence2":
        if cfg.edge % CELL:
            raise TrainError(
                "the images do not fit Florence-2", expected=f"an edge that is a multiple of {CELL} px", found=cfg.edge
            )
        return
    if cfg.weights is not None:
        fix = "choose the backbone florence2, or leave the weights out"
        raise TrainError("the backbone small takes no weights", found=cfg.weights, fix=fix)
    if not cfg.small.channels:
        raise TrainError("the backbone small has no channels", expected="at least one level")
    if cfg.edge < 2 ** len(cfg.small.channels):
        raise TrainError(
            "the images are smaller than one token",
            expected=f"an edge of at least {2 ** len(cfg.small.channels)} px",
            found=cfg.edge,
        )


def check_train_cfg(cfg: TrainFlowCfg) -> None:
    """Check the settings of a training.

    Raises:
        TrainError: A setting is out of bounds or contradicts another one.
    """
    check_settings(cfg, TrainError)
    check_policy_cfg(cfg.policy)
    if cfg.policy.backbone == "florence2" and cfg.policy.weights is None:
        fix = "give the folder of a copy of florence-community/Florence-2-large"
        raise TrainError("Florence-2 needs weights", expected="policy.weights", found="none", fix=fix)


def holds_flow_policy(path: Path) -> bool:
    """Return whether a folder, or the folder of a checkpoint file, is the run folder of a flow policy."""
    return ((path if path.is_dir() else path.parent) / FLOW_SETTINGS).is_file()
