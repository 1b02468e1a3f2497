"""A trained student: a policy that acts by images and by what the robot knows of itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from concent_warp.checkpoint_file import check_state
from concent_warp.errors import TrainError
from concent_warp.train.distil.cfg import DISTIL_SETTINGS, DistilCfg, holds_student
from concent_warp.train.distil.dagger import load_student_checkpoint, make_network
from concent_warp.train.distil.images import DelayedImages, ImageSource
from concent_warp.train.distil.network import StudentNetwork
from concent_warp.train.distil.proprioception import Proprioception
from concent_warp.train.distil.run import TEACHER
from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.observation import ObservationLayout
from concent_warp.train.learning.ppo import CHECKPOINT
from concent_warp.train.policy.load import Policy
from concent_warp.train.run import TrainingRun
from concent_warp.train.trials.episodes import PolicyFunction


@dataclass(frozen=True)
class Student:
    """A policy that sees.

    Example:
        >>> import concent_warp as cw
        >>> cfg = cw.DistilCfg(states=4, images=cw.ImagesCfg(size=16), dagger=cw.DaggerCfg(
        ...     iterations=1, worlds=2, steps=2, updates=1, batch=2))
        >>> student = cw.distil(cw.load_policy("shape_sorter"), cfg, device="cpu")
        >>> student.cfg.images.cameras
        ('base', 'wrist')
    """

    teacher: Policy
    """The policy that it was distilled from, with the task."""
    cfg: DistilCfg
    """Settings of the distillation."""
    weights: Mapping[str, Any] = field(repr=False)
    """Checkpoint: tensors and plain data by name."""
    folder: Path
    """Run folder."""

    @staticmethod
    def load(source: str | Path) -> Student:
        """Return the student of a run folder, or of a checkpoint file in one.

        Raises:
            TrainError: There is no student.
        """
        path = Path(source)
        if not holds_student(path):
            raise TrainError("the folder holds no student", where=path, expected=f"a {DISTIL_SETTINGS}")
        checkpoint = path / CHECKPOINT if path.is_dir() else path
        if not checkpoint.exists():
            raise TrainError("no such checkpoint", where=checkpoint, expected=f"a {CHECKPOINT} of concent distil")
        folder = checkpoint.parent
        cfg, weights = DistilCfg.load(folder / DISTIL_SETTINGS), load_student_checkpoint(checkpoint)
        kept = {name: weights[name] for name in ("student", "iteration", "steps", "seconds")}
        return Student(Policy.load(folder / TEACHER), cfg, kept, folder)

    @property
    def run(self) -> TrainingRun:
        """Model, demonstration, contact events and settings of the teacher's training."""
        return self.teacher.run

    @property
    def pretrained(self) -> bool:
        """Whether the policy comes with the package."""
        return False

    def network(self) -> tuple[StudentNetwork, Proprioception]:
        """Return the network with its weights, on the CPU, and what the robot knows of itself.

        Raises:
            TrainError: The weights are of another network.
        """
        task = self.run.task()
        proprioception = Proprioception(ObservationLayout.of(task, self.run.cfg.environment.observation))
        network = make_network(self.cfg, proprioception, task.robot.actions)
        found = self.weights["student"]
        check_state(found, network.state_dict(), "the student's network", where=self.folder, error=TrainError)
        network.load_state_dict(found)
        return network.eval(), proprioception

    def controller(self, device: str = "cpu") -> StudentController:
        """Return what acts by arrays, without an environment, on a device by torch's name."""
        network, proprioception = self.network()
        return StudentController(network.to(device), self.cfg, proprioception, device)

    def act_in(
        self, environment: Environment, images: ImageSource, *, delay: tuple[int, int] | None = None
    ) -> PolicyFunction:
        """Return the function from an environment's observations to actions; it renders what the student sees.

        Args:
            environment: The worlds.
            images: Their cameras.
            delay: Least and largest delay of the images [control steps]; that of the settings by default.
        """
        network, proprioception = self.network()
        line = DelayedImages(images, self.cfg.images.frames, self.cfg.images.delay if delay is None else delay)

        def act(observation: TensorDict) -> torch.Tensor:
            del observation  # the same as the environment's, without the objects
            started = environment.episode_length_buf == 0
            with torch.no_grad():
                seen = line.look(environment, started)
                network.to(seen.device)
                own = proprioception.read(environment.observation).to(seen.device)
                return network(seen.float() / 255, own).to(environment.device)

        return act

    def scaled(self, action_scale: float = 1.0, setpoint_lead_scale: float = 1.0) -> Student:
        """Return the student with smaller command steps and leads, see `Policy.scaled`."""
        return replace(self, teacher=self.teacher.scaled(action_scale, setpoint_lead_scale))

    def export(self, out: str | Path) -> dict[str, Any]:
        """Write the student as ONNX (``.onnx``) or TorchScript (``.pt``) and return its metadata.

        Raises:
            TrainError: The file has another suffix.
        """
        from concent_warp.train.distil.export import export_student

        return export_student(self.run, self.cfg, self.network()[0], self.weights, Path(out))


class StudentController:
    """Acts by arrays, as on a robot: one call per control period."""

    def __init__(self, network: StudentNetwork, cfg: DistilCfg, proprioception: Proprioception, device: str) -> None:
        """Keep the network and what it expects."""
        size = cfg.images.size
        self.images = (len(cfg.images.cameras), 3 * cfg.images.frames, size, size)
        """Shape of the images of a world: cameras, colours of successive images (the latest first), height, width."""
        self.proprioception = proprioception
        """Names and widths of what the robot has to know of itself."""
        self._network, self._device = network, device

    def act(self, images: np.ndarray | torch.Tensor, proprioception: np.ndarray | torch.Tensor) -> np.ndarray:
        """Return actions in -1..1, shape (N, A) float32.

        Args:
            images: Colours, uint8, shape (N, *self.images).
            proprioception: What the robot knows of itself, shape (N, P), as `Environment.observation` has it.

        Raises:
            TrainError: An argument has another shape or type.
        """
        seen, own = torch.as_tensor(images), torch.as_tensor(proprioception)
        if seen.ndim != 5 or tuple(seen.shape[1:]) != self.images or seen.dtype != torch.uint8:
            raise TrainError(
                "the images are not as the student sees them", expected=f"uint8 of shape (N, {self.images})",
                found=f"{seen.dtype} of shape {tuple(seen.shape)}",
            )  # fmt: skip
        if tuple(own.shape) != (len(seen), self.proprioception.size):
            raise TrainError(
                "the proprioception is not as the student has it", expected=(len(seen), self.proprioception.size),
                found=tuple(own.shape),
            )  # fmt: skip
        with torch.no_grad():
            return self._network(seen.to(self._device).float() / 255, own.to(self._device).float()).cpu().numpy()


def load_student(source: str | Path) -> Student:
    """Return a trained student.

    Args:
        source: Run folder of a distillation, or a checkpoint file in one.

    Raises:
        TrainError: There is no student.

    Example:
        >>> import concent_warp as cw
        >>> cfg = cw.DistilCfg(states=4, images=cw.ImagesCfg(size=16), dagger=cw.DaggerCfg(
        ...     iterations=1, worlds=2, steps=2, updates=1, batch=2))
        >>> student = cw.distil(cw.load_policy("shape_sorter"), cfg, device="cpu", out="student")
        >>> cw.load_student("student").weights["iteration"]
        1
    """
    return Student.load(source)
