"""A trained flow policy: from images, proprioception and text to chunks of actions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from concent_warp.checkpoint_file import check_state, read_checkpoint, write_checkpoint
from concent_warp.checks import check_device
from concent_warp.errors import ConcentError, TrainError
from concent_warp.events.decode import decode
from concent_warp.run_folder import TRAIN_CHECKPOINT
from concent_warp.train.flow.cfg import FlowPolicyCfg, check_policy_cfg
from concent_warp.train.flow.dataset import FlowFeatures
from concent_warp.train.flow.network import FlowPolicyNetwork, prepared

POLICY = "flow_policy.pt"
"""File of the policy in the run folder of a finished training."""
PARTS = ("policy", "features", "backbone", "weights")
MODULE = "module."
"""Begins the names of weights in a running mean."""
Array = np.ndarray | torch.Tensor


@dataclass(frozen=True)
class FlowPolicy:
    """A policy that sees, reads an instruction, and returns chunks of actions.

    Example:
        >>> import concent_warp as cw
        >>> try:
        ...     cw.load_flow_policy("nowhere")
        ... except cw.TrainError as error:
        ...     str(error).startswith("nowhere: no such flow policy")
        True
    """

    cfg: FlowPolicyCfg
    """Inputs and sizes."""
    features: FlowFeatures
    """Names of cameras, proprioception and actions, rate, and the instructions that it was trained with."""
    network: FlowPolicyNetwork = field(repr=False)
    """The network, in evaluation mode."""
    folder: Path
    """Run folder; the working directory where there is none."""

    @staticmethod
    def load(source: str | Path, *, device: str | None = None) -> FlowPolicy:
        """Return a flow policy.

        Args:
            source: Run folder of a training, finished or not, or a file in one.
            device: Torch's name of the device; the CPU by default.

        Raises:
            TrainError: There is none, or the file is of something else.
        """
        path = Path(source)
        check_device(device)
        if path.is_dir():
            path = next((f for name in (POLICY, TRAIN_CHECKPOINT) if (f := path / name).is_file()), path)
        if not path.is_file():
            expected = f"the run folder of concent train-flow, or its {POLICY}"
            raise TrainError("no such flow policy", where=path, expected=expected)
        document = read_checkpoint(path, keys=PARTS[:3], finite=("weights", "mean"), error=TrainError)
        return policy_of(document, path, device or "cpu")

    @property
    def device(self) -> torch.device:
        """Where the network is."""
        return self.network.action_mean.device

    def act(
        self,
        images: Mapping[str, Array],
        proprioception: Array,
        text: str | Sequence[str],
        *,
        noise: Array | None = None,
    ) -> np.ndarray:
        """Return chunks of actions, shape (N, C, A) float32, in the units of the data set.

        Args:
            images: Images by the names of the cameras, each (N, H, W, 3) uint8 of any size.
            proprioception: State of the robot in the units of the data set, shape (N, P), in the order of
                `features.state`.
            text: An instruction for all, or N of them.
            noise: Normally distributed numbers that the flow starts from, shape (N, C, A); by default of torch's
                generator. The same noise gives the same chunks.

        Raises:
            TrainError: An input is missing or has another shape or type, or an instruction is too long.
        """
        count = self._check_inputs(images, proprioception)
        texts = [text] * count if isinstance(text, str) else list(text)
        if len(texts) != count:
            raise TrainError("the number of instructions is not right", expected=f"1 or {count}", found=len(texts))
        shape = count, self.cfg.chunk, len(self.features.action)
        if noise is not None and tuple(noise.shape) != shape:
            raise TrainError("the noise has another shape", expected=shape, found=tuple(noise.shape))
        device = self.device
        with torch.inference_mode(), torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
            start = torch.randn(shape, device=device) if noise is None else torch.as_tensor(noise).to(device).float()
            shown = torch.stack([self._shown(images[name]) for name in self.features.cameras], dim=1)
            ids, mask = (part.to(device) for part in self.network.tokens_of(texts))
            state = torch.as_tensor(proprioception).to(device).float()
            context, there = self.network.context(shown, state, ids, mask)
            return self.network.sample(context, there, start).float().cpu().numpy()

    def save(self, path: str | Path) -> None:
        """Write the policy to a file, which `load` reads."""
        write_policy(Path(path), self.cfg, self.features, self.network)

    def export(self, out: str | Path) -> dict[str, Any]:
        """Write the sampler of chunks as ONNX and return its metadata; see `docs/flow_policy.md` for its inputs.

        Raises:
            TrainError: The file has another suffix, or the network cannot be exported.
        """
        from concent_warp.train.flow.export import export_flow_policy

        return export_flow_policy(self.cfg, self.features, self.network, Path(out))

    def _shown(self, images: Array) -> torch.Tensor:
        """Return images (N, H, W, 3) uint8 as the network takes them, shape (N, 3, S, S) in 0..1."""
        given = torch.as_tensor(np.ascontiguousarray(images) if isinstance(images, np.ndarray) else images)
        return prepared(given.to(self.device), self.cfg.edge).permute(0, 3, 1, 2).float() / 255

    def _check_inputs(self, images: Mapping[str, Array], proprioception: Array) -> int:
        """Return the number of observations N.

        Raises:
            TrainError: An input is missing or has another shape or type.
        """
        if missing := [name for name in self.features.cameras if name not in images]:
            raise TrainError(
                f"there are no images of {missing[0]!r}", expected=list(self.features.cameras), found=list(images)
            )
        shape, width = tuple(np.shape(proprioception)), len(self.features.state)
        if len(shape) != 2 or shape[1] != width:
            raise TrainError("the proprioception has another shape", expected=f"(N, {width})", found=shape)
        for name in self.features.cameras:
            image = images[name]
            kind = str(image.dtype).removeprefix("torch.")
            if image.ndim != 4 or image.shape[0] != shape[0] or image.shape[3] != 3 or kind != "uint8":
                expected, found = f"({shape[0]}, H, W, 3) uint8", f"{tuple(image.shape)} {kind}"
                raise TrainError("images are not right", where=name, expected=expected, found=found)
        return shape[0]


def policy_of(document: Mapping[str, Any], where: Path, device: str = "cpu") -> FlowPolicy:
    """Return the policy of a document that `write_policy` or a training wrote.

    Raises:
        TrainError: It does not describe a flow policy, or its weights are of another one.
    """
    try:
        cfg = decode(FlowPolicyCfg, document["policy"], str(where))
        features = FlowFeatures.of(document["features"])
    except (ConcentError, KeyError, TypeError, ValueError) as error:
        raise TrainError("not a flow policy", where=where, found=error) from None
    check_policy_cfg(cfg)
    sizes = len(features.cameras), len(features.state), len(features.action)
    network = FlowPolicyNetwork(cfg, *sizes, document["backbone"] or {})
    weights = document.get("weights")
    if weights is None:
        mean = document.get("mean") or {}
        weights = {n.removeprefix(MODULE): value for n, value in mean.items() if n.startswith(MODULE)}
    check_state(weights, network.state_dict(), "the policy's network", where=where, error=TrainError)
    network.load_state_dict(weights)
    return FlowPolicy(cfg, features, network.to(device).eval(), where.parent)


def write_policy(path: Path, cfg: FlowPolicyCfg, features: FlowFeatures, network: FlowPolicyNetwork) -> None:
    """Write a policy to a file atomically."""
    from dataclasses import replace

    from concent_warp.run_folder import plain

    weights = {name: value.detach().cpu() for name, value in network.state_dict().items()}
    described = (plain(replace(cfg, weights=None)), features.plain(), network.described_backbone())
    write_checkpoint(path, dict(zip(PARTS, (*described, weights), strict=True)))


def load_flow_policy(source: str | Path, *, device: str | None = None) -> FlowPolicy:
    """Return a trained flow policy.

    Args:
        source: Run folder of a training by `train_flow`, finished or not, or a file in one.
        device: Torch's name of the device; the CPU by default.

    Raises:
        TrainError: There is none, or the file is of something else.

    Example:
        >>> import concent_warp as cw
        >>> try:
        ...     cw.load_flow_policy("nowhere")
        ... except cw.TrainError as error:
        ...     print(error)
        nowhere: no such flow policy; expected the run folder of concent train-flow, or its flow_policy.pt.
    """
    return FlowPolicy.load(source, device=device)
