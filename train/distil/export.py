"""Export of a student as ONNX or TorchScript, with everything needed to run it in the metadata."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from concent_warp.train.distil.cfg import DistilCfg
from concent_warp.train.distil.network import StudentNetwork
from concent_warp.train.distil.proprioception import OWN, Proprioception
from concent_warp.train.environment.observation import ObservationLayout
from concent_warp.train.policy.export import check_suffix, describe, write_module
from concent_warp.train.run import TrainingRun

FORMAT = "concent-student"
IMAGES, PROPRIOCEPTION = "images", "proprioception"


class _FromBytes(nn.Module):
    """The student from images as bytes."""

    def __init__(self, network: StudentNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: torch.Tensor, proprioception: torch.Tensor) -> torch.Tensor:
        """Return actions, shape (N, A)."""
        return self.network(images.float() / 255, proprioception)


def export_student(
    run: TrainingRun, cfg: DistilCfg, network: StudentNetwork, weights: Mapping[str, Any], out: Path
) -> dict[str, Any]:
    """Write a student, and return its metadata.

    Args:
        run: Inputs of the teacher's training.
        cfg: Settings of the distillation.
        network: The student's network.
        weights: Checkpoint of the student, of which iterations and steps are read.
        out: File to write: ``.onnx`` for ONNX, ``.pt`` for TorchScript.

    Raises:
        TrainError: The file has another suffix.
    """
    check_suffix(out)
    task, images = run.task(), cfg.images
    proprioception = Proprioception(ObservationLayout.of(task, run.cfg.environment.observation))
    described = describe(run.cfg, task)
    seen = described["observation"]
    seen["parts"] = [part for part in seen["parts"] if part["name"] in OWN]
    seen |= {"input": PROPRIOCEPTION, "size": proprioception.size}
    for name in ("slots", "history"):
        del seen[name]
    shape = [len(images.cameras), 3 * images.frames, images.size, images.size]
    described |= {"format": FORMAT, "iterations": weights["iteration"], "steps": weights["steps"]}
    described["moving on"] = None
    described[IMAGES] = {
        "input": IMAGES,
        "cameras": list(images.cameras),
        "shape": shape,
        "frames": images.frames,
        "meaning": "uint8, shape (worlds, cameras, 3 * frames, height, width): red, green and blue of the latest "
        "image, then of those one control period apart before it; at the start of an episode the first one instead",
    }
    example = {
        IMAGES: torch.zeros(2, *shape, dtype=torch.uint8),
        PROPRIOCEPTION: torch.zeros(2, proprioception.size),
    }
    write_module(_FromBytes(network).eval(), example, described, out)
    return described
