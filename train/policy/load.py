"""A trained policy with the inputs of its training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from concent_warp.errors import TrainError
from concent_warp.run_folder import check_training
from concent_warp.train.environment.environment import Environment
from concent_warp.train.learning.best_policy import chosen_weights
from concent_warp.train.learning.ppo import CHECKPOINT, Trainer, load_checkpoint
from concent_warp.train.policy.pretrained import FOLDER, pretrained_checkpoint, pretrained_names
from concent_warp.train.run import TrainingRun
from concent_warp.train.trials.episodes import PolicyFunction


@dataclass(frozen=True)
class Policy:
    """A trained policy.

    Example:
        >>> import concent_warp as cw
        >>> policy = cw.load_policy("shape_sorter")
        >>> [stage.name for stage in policy.run.events.stages]
        ['pick', 'align', 'insert']
    """

    run: TrainingRun
    """Model, demonstration, contact events and settings of the training."""
    weights: Mapping[str, Any] = field(repr=False)
    """Checkpoint: tensors and plain data by name."""
    folder: Path
    """Run folder."""

    @staticmethod
    def load(source: str | Path) -> Policy:
        """Return a policy.

        Args:
            source: Run folder of a training, a checkpoint file in one, or the name of a pretrained policy.

        Raises:
            TrainError: The training or the policy does not exist, or the file is no checkpoint.
        """
        path = Path(source)
        if isinstance(source, str) and not path.exists() and path.name == source:
            if source not in pretrained_names():
                expected = f"a run folder, a checkpoint file, or one of {pretrained_names()}"
                raise TrainError("no such policy", expected=expected, found=source)
            path = pretrained_checkpoint(source)
        check_training(path)
        checkpoint = path / CHECKPOINT if path.is_dir() else path
        weights = chosen_weights(load_checkpoint(checkpoint))
        return Policy(TrainingRun.load(checkpoint.parent), weights, checkpoint.parent)

    @property
    def stress(self) -> tuple[int, int] | None:
        """Successes and episodes of the stress test by which the policy was chosen; None without a test."""
        found = self.weights.get("stress")
        return None if found is None else (int(found["successes"]), int(found["episodes"]))

    @property
    def pretrained(self) -> bool:
        """Whether the policy comes with the package."""
        return self.folder.parent == FOLDER

    def act_in(self, environment: Environment) -> PolicyFunction:
        """Return the function from an environment's observations to actions, on the environment's device."""
        trainer = Trainer(environment, self.run.cfg)
        trainer.begin_with(self.weights, self.folder)
        return trainer.policy()

    def scaled(self, action_scale: float = 1.0, setpoint_lead_scale: float = 1.0) -> Policy:
        """Return the policy with smaller command steps and leads.

        Args:
            action_scale: Size of command steps relative to training, above 0 and at most 1: below 1 the robot moves
                more slowly.
            setpoint_lead_scale: Largest difference of command and joint position relative to training, above 0 and at
                most 1: with the stiffness of the drives it bounds the force that the robot exerts.

        Raises:
            TrainError: A scale is out of bounds.
        """
        for name, scale in (("action scale", action_scale), ("setpoint lead scale", setpoint_lead_scale)):
            if not 0 < scale <= 1:
                raise TrainError(f"the {name} is out of bounds", expected="above 0, at most 1", found=scale)
        environment = self.run.cfg.environment
        action = environment.action
        action = replace(
            action,
            turn=action_scale * action.turn,
            slide=action_scale * action.slide,
            gripper=action_scale * action.gripper,
            gripper_share=action_scale * action.gripper_share,
            turn_lead=setpoint_lead_scale * action.turn_lead,
            slide_lead=setpoint_lead_scale * action.slide_lead,
        )
        cfg = replace(self.run.cfg, environment=replace(environment, action=action))
        return replace(self, run=replace(self.run, cfg=cfg))

    def export(self, out: str | Path) -> dict[str, Any]:
        """Write the policy as ONNX (``.onnx``) or TorchScript (``.pt``) and return its metadata.

        Raises:
            TrainError: The file has another suffix.
        """
        from concent_warp.train.policy.export import export

        return export(self.run, self.weights, Path(out))


def load_policy(source: str | Path) -> Policy:
    """Return a trained or pretrained policy.

    Args:
        source: Run folder of a training, a checkpoint file in one, or the name of a pretrained policy:
            "shape_sorter" inserts, "pick_align_insert" performs the whole task.

    Raises:
        TrainError: The training or the policy does not exist, or the file is no checkpoint.

    Example:
        >>> import concent_warp as cw
        >>> cw.load_policy("pick_align_insert").run.cfg.environment.stage
        'all'
    """
    return Policy.load(source)
