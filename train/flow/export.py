"""Export of a flow policy as ONNX: the whole sampler, from images, proprioception, text and noise to a chunk.

The images have the size of the policy; normalisation and Euler steps are in the graph. What the tokens of a text are
is in the metadata: the bytes of UTF-8 behind a first token 256, or the tokenizer of Florence-2.
"""

from __future__ import annotations

import contextlib
import copy
import io
import json
import logging
import warnings
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from concent_warp.errors import TrainError
from concent_warp.files import write_bytes
from concent_warp.train.flow.cfg import FlowPolicyCfg
from concent_warp.train.flow.dataset import FlowFeatures
from concent_warp.train.flow.network import FlowPolicyNetwork

FORMAT, VERSION = "concent-flow-policy", 1
METADATA = "concent"
"""Key of the metadata."""
OPSET = 18
SUFFIX = ".onnx"
EXAMPLES, EXAMPLE_TOKENS = 2, 5
"""Observations and tokens of the inputs that the graph is traced with."""


class _Encoder(nn.Module):
    """From the observation to its tokens."""

    def __init__(self, network: FlowPolicyNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, images: list[torch.Tensor], proprioception: torch.Tensor, tokens: torch.Tensor, mask: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return tokens and which there are; images are (N, S, S, 3) uint8, one for each camera."""
        shown = torch.stack([image.permute(0, 3, 1, 2).float() / 255 for image in images], dim=1)
        return self.network.context(shown, proprioception, tokens, mask)


class _EulerStep(nn.Module):
    """One Euler step of the flow."""

    def __init__(self, network: FlowPolicyNetwork) -> None:
        super().__init__()
        self.transformer, self.steps = network.transformer, network.cfg.euler_steps

    def forward(
        self, step: torch.Tensor, chunk: torch.Tensor, context: torch.Tensor, there: torch.Tensor
    ) -> torch.Tensor:
        """Return the normalised chunk (N, C, A) after a step, whose number is an int64 of shape ()."""
        time = (step.float() / self.steps).expand(chunk.shape[0])
        return chunk + self.transformer(chunk, time, context, there) / self.steps


def export_flow_policy(
    cfg: FlowPolicyCfg, features: FlowFeatures, network: FlowPolicyNetwork, out: Path
) -> dict[str, Any]:
    """Write the sampler as ONNX, for any number of observations and tokens, and return its metadata.

    Raises:
        TrainError: The file has another suffix, or the network cannot be exported.
    """
    if out.suffix != SUFFIX:
        raise TrainError("the export format is unknown", where=out, expected=f"a name in {SUFFIX}")
    described = _described(cfg, features, network)
    write_bytes(out, _onnx(features, network, described))
    return described


def _described(cfg: FlowPolicyCfg, features: FlowFeatures, network: FlowPolicyNetwork) -> dict[str, Any]:
    """Return the metadata as plain data."""
    backbone = network.described_backbone()
    text = {"tokenizer": json.loads(backbone["tokenizer"])} if backbone else {"bytes": "UTF-8", "first": 256}
    return {
        "format": FORMAT,
        "version": VERSION,
        "images": {f"image_{name}": [cfg.edge, cfg.edge, 3] for name in features.cameras},
        "proprioception": list(features.state),
        "action": list(features.action),
        "chunk": cfg.chunk,
        "execute": cfg.execute,
        "euler steps": cfg.euler_steps,
        "rate": features.rate,
        "instructions": list(features.tasks),
        "text": text,
        "inputs": "images uint8 (N, S, S, 3); proprioception float (N, P); tokens int64 (N, L) and mask bool (N, L) of "
        "the instruction; noise float (N, C, A), normally distributed; output chunk float (N, C, A)",
        "versions": {name: version(name) for name in ("concent-warp", "torch", "onnx")},
    }


def _onnx(features: FlowFeatures, network: FlowPolicyNetwork, described: dict[str, Any]) -> bytes:
    """Return the sampler as ONNX, with the weights inside: the encoder, and a loop over Euler steps."""
    import onnx

    cfg = network.cfg
    network = copy.deepcopy(network).cpu().float().eval()
    count, edge = EXAMPLES, cfg.edge
    images = [torch.zeros(count, edge, edge, 3, dtype=torch.uint8) for _ in features.cameras]
    ids = torch.zeros(count, EXAMPLE_TOKENS, dtype=torch.int64)
    observation = (images, torch.zeros(count, len(features.state)), ids, torch.ones_like(ids, dtype=torch.bool))
    observations, tokens = torch.export.Dim("observations"), torch.export.Dim("tokens")
    text = {0: observations, 1: tokens}
    shapes = ([{0: observations} for _ in images], {0: observations}, text, text)
    names = [*(f"image_{name}" for name in features.cameras), "proprioception", "tokens", "mask"]
    encoder = _exported(_Encoder(network), observation, shapes, names, ["context", "there"])
    with torch.no_grad():
        context, there = network.context(torch.zeros(count, len(images), 3, edge, edge), *observation[1:])
    chunk = torch.zeros(count, cfg.chunk, len(features.action))
    inner = {0: observations, 1: torch.export.Dim("context_tokens")}
    step = _exported(
        _EulerStep(network), (torch.tensor(0), chunk, context, there), ({}, {0: observations}, inner, inner),
        ["step", "chunk", "context", "there"], ["moved"],
    )  # fmt: skip
    model = _looped(encoder, step, network)
    onnx.helper.set_model_props(model, {METADATA: json.dumps(described)})
    onnx.checker.check_model(model, full_check=False)
    return model.SerializeToString()


def _exported(module: nn.Module, example: tuple[Any, ...], shapes: Any, inputs: list[str], outputs: list[str]) -> Any:
    """Return a module as an ONNX model.

    Raises:
        TrainError: It cannot be exported.
    """
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():  # the exporter prints and logs
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                module, example, input_names=inputs, output_names=outputs, opset_version=OPSET, dynamo=True,
                dynamic_shapes=shapes, verbose=False,
            )  # fmt: skip
    except torch.onnx.OnnxExporterError as error:
        cause: BaseException = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        raise TrainError("the policy cannot be exported as ONNX", found=" ".join(str(cause).split())[:200]) from None
    finally:
        logging.disable(level)
    assert program is not None
    return program.model_proto


def _looped(encoder: Any, step: Any, network: FlowPolicyNetwork) -> Any:
    """Return the model of the sampler from those of the encoder and of an Euler step.

    The step is the body of a Loop, whose first input is the number of the step; the tokens come from outside of it.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    step = onnx.compose.add_prefix(step, "euler/")
    number, chunk, context, there = step.graph.input
    outside = {context.name: "context", there.name: "there"}
    for node in step.graph.node:
        node.input[:] = [outside.get(name, name) for name in node.input]
    go_on = helper.make_tensor_value_info("euler/go_on", TensorProto.BOOL, [])
    still = helper.make_tensor_value_info("euler/still", TensorProto.BOOL, [])
    nodes = [*step.graph.node, helper.make_node("Identity", ["euler/go_on"], ["euler/still"])]
    body = helper.make_graph(
        nodes, "euler_step", [number, go_on, chunk], [still, *step.graph.output], list(step.graph.initializer)
    )
    constants = {
        "steps": np.array(network.cfg.euler_steps, dtype=np.int64),
        "go_on": np.array(True),
        "action_mean": network.action_mean.numpy(),
        "action_std": network.action_std.numpy(),
    }
    graph = encoder.graph
    shape = ["observations", network.cfg.chunk, len(network.action_mean)]
    graph.node.extend(
        [
            helper.make_node("Loop", ["steps", "go_on", "noise"], ["normalised"], body=body),
            helper.make_node("Mul", ["normalised", "action_std"], ["scaled"]),
            helper.make_node("Add", ["scaled", "action_mean"], ["chunk"]),
        ]
    )
    graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in constants.items())
    graph.input.append(helper.make_tensor_value_info("noise", TensorProto.FLOAT, shape))
    del graph.output[:]
    graph.output.append(helper.make_tensor_value_info("chunk", TensorProto.FLOAT, shape))
    known = {(one.domain, one.name) for one in encoder.functions}
    encoder.functions.extend(one for one in step.functions if (one.domain, one.name) not in known)
    return encoder
