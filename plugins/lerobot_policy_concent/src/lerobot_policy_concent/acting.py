"""Students and flow policies of ConCent-Warp as modules that act by lerobot's batches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE, OBS_STR
from torch import nn

from concent_warp import FlowPolicy, FlowPolicyCfg, Student, StudentNetworkCfg, TrainError
from concent_warp.events.decode import decode
from concent_warp.run_folder import plain
from concent_warp.train.distil.cfg import holds_student
from concent_warp.train.distil.network import StudentNetwork
from concent_warp.train.flow.cfg import holds_flow_policy
from concent_warp.train.flow.dataset import FlowFeatures
from concent_warp.train.flow.network import FlowPolicyNetwork, prepared

PROPRIOCEPTION, COMMAND = f"{OBS_STR}.proprioception", f"{OBS_STR}.command"
"""What a student needs besides images: the environment of lerobot_env_concent has both."""


class ActingFlow(nn.Module):
    """A flow policy; its actions are those of the data set that it learned from."""

    def __init__(self, cfg: FlowPolicyCfg, features: FlowFeatures, network: FlowPolicyNetwork) -> None:
        """Keep the policy."""
        super().__init__()
        self.network = network.eval()
        self._policy = FlowPolicy(cfg, features, network, Path())
        self.cameras, self.size, self.actions = features.cameras, features.size, len(features.action)
        self.numbers = {OBS_STATE: len(features.state)}
        self.chunk, self.execute = cfg.chunk, cfg.execute

    def reset(self) -> None:
        """Do nothing: a flow policy has no memory."""

    def see(self, batch: dict[str, Any]) -> None:
        """Do nothing, likewise."""

    def chunk_of(self, batch: dict[str, Any], instruction: str | None, noise: torch.Tensor | None) -> torch.Tensor:
        """Return chunks, shape (N, C, A); see `ConcentPolicy.predict_action_chunk`."""
        state = _given(batch, OBS_STATE)
        images = {name: _bytes_of(_given(batch, f"{OBS_IMAGES}.{name}")) for name in self.cameras}
        text = self._text(batch.get("task"), len(state)) if instruction is None else instruction
        return torch.from_numpy(self._policy.act(images, state, text, noise=noise)).to(state.device)

    def _text(self, task: Any, count: int) -> list[str]:
        """Return the instructions; where there is none, the only one that the policy knows.

        Raises:
            TrainError: There is none, and the policy knows several.
        """
        texts = [task or ""] * count if isinstance(task, str | None) else [str(one or "") for one in task]
        known = self._policy.features.tasks
        if not all(texts) and len(known) != 1:
            fix = "give one with --policy.instruction"
            raise TrainError("the policy needs an instruction", expected=f"such as {list(known)}", found=texts, fix=fix)
        return [text or known[0] for text in texts]


class ActingStudent(nn.Module):
    """A student; the steps of the commands that it acts by are added to the present commands."""

    def __init__(self, described: dict[str, Any], network: StudentNetwork) -> None:
        """Keep the network; `described` is what `describe_student` returns."""
        super().__init__()
        self.network = network.eval()
        self.cameras, edge = tuple(described["cameras"]), int(described["size"])
        self.size, self._edge, self._frames = (edge, edge), edge, int(described["frames"])
        self._arm, self._gripper, self.actions = described["arm"], described["gripper"], int(described["commands"])
        self.numbers = {PROPRIOCEPTION: int(described["proprioception"]), COMMAND: self.actions}
        self.chunk = self.execute = 1
        self.register_buffer("step", torch.tensor(described["step"]), persistent=False)
        self._seen: list[torch.Tensor] = []

    def reset(self) -> None:
        """Forget past images."""
        self._seen = []

    def see(self, batch: dict[str, Any]) -> None:
        """Keep the images of a step; before the first, all was as it is."""
        shown = torch.stack([self._shown(_given(batch, f"{OBS_IMAGES}.{name}")) for name in self.cameras], dim=1)
        self._seen = [shown, *(self._seen or [shown] * (self._frames - 1))][: self._frames]

    def chunk_of(self, batch: dict[str, Any], instruction: str | None, noise: torch.Tensor | None) -> torch.Tensor:
        """Return commands, shape (N, 1, A); see `ConcentPolicy.predict_action_chunk`."""
        del instruction, noise  # a student knows one task, and acts by no chance
        if not self._seen:
            self.see(batch)
        own, command = (_given(batch, name).float() for name in (PROPRIOCEPTION, COMMAND))
        action = self.network(torch.cat(self._seen, dim=2).float() / 255, own).to(command.device)
        joints, step = len(self._arm), self.get_buffer("step").to(command.device)
        wanted = command.clone()
        wanted[:, self._arm] += action[:, :joints] * step[:joints]
        wanted[:, self._gripper] += action[:, joints:] * step[joints:]
        return wanted[:, None]

    def _shown(self, images: torch.Tensor) -> torch.Tensor:
        """Return images as the student sees them, uint8, shape (N, 3, S, S)."""
        return prepared(_bytes_of(images), self._edge).permute(0, 3, 1, 2)


def described_run(path: Path) -> tuple[dict[str, Any], ActingFlow | ActingStudent]:
    """Return the description of the policy of a run folder as plain data, and the policy.

    Raises:
        TrainError: The folder holds no policy that sees.
    """
    if holds_flow_policy(path):
        policy = FlowPolicy.load(path)
        described = {
            "kind": "flow", "policy": plain(replace(policy.cfg, weights=None)), "features": policy.features.plain(),
            "backbone": policy.network.described_backbone(),
        }  # fmt: skip
        return described, ActingFlow(policy.cfg, policy.features, policy.network)
    if not holds_student(path):
        raise TrainError("no policy that sees", where=path, expected="a run folder of concent distil or train-flow")
    described, network = describe_student(Student.load(path))
    return described, ActingStudent(described, network)


def describe_student(student: Student) -> tuple[dict[str, Any], StudentNetwork]:
    """Return what an acting student needs to know, as plain data, and its network."""
    network, proprioception = student.network()
    task, images = student.run.task(), student.cfg.images
    described = {
        "kind": "student", "network": plain(student.cfg.network), "cameras": list(images.cameras),
        "frames": images.frames, "size": images.size, "proprioception": proprioception.size,
        "objects": proprioception.objects, "commands": int(task.compiled.nu), "arm": task.robot.actuator.tolist(),
        "gripper": task.robot.gripper.tolist(), "step": [float(one) for one in task.robot.step],
    }  # fmt: skip
    return described, network


def acting_of(described: dict[str, Any]) -> ActingFlow | ActingStudent:
    """Return a policy with random weights of a description that `described_run` returned.

    Raises:
        TrainError: It is of another kind.
    """
    where = "config.json"
    if described.get("kind") == "flow":
        cfg = decode(FlowPolicyCfg, described["policy"], where)
        features = FlowFeatures.of(described["features"])
        sizes = len(features.cameras), len(features.state), len(features.action)
        return ActingFlow(cfg, features, FlowPolicyNetwork(cfg, *sizes, described["backbone"]))
    if described.get("kind") == "student":
        network = StudentNetwork(
            len(described["cameras"]), described["frames"], described["size"], described["proprioception"],
            len(described["step"]), described["objects"], decode(StudentNetworkCfg, described["network"], where),
        )  # fmt: skip
        return ActingStudent(described, network)
    raise TrainError("no such kind of policy", where=where, expected="flow or student", found=described.get("kind"))


def _given(batch: dict[str, Any], name: str) -> torch.Tensor:
    """Return an entry of a batch.

    Raises:
        TrainError: There is none.
    """
    if name not in batch:
        raise TrainError("the observation lacks what the policy needs", expected=name, found=sorted(batch))
    return batch[name]


def _bytes_of(images: torch.Tensor) -> torch.Tensor:
    """Return images (N, 3, H, W), in 0..1 or uint8, as (N, H, W, 3) uint8."""
    whole = images if images.dtype == torch.uint8 else (255 * images).round().clamp(0, 255).to(torch.uint8)
    return whole.permute(0, 2, 3, 1)
