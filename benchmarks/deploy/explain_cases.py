"""Cases whose cause is known: biased perception, changed physics, weak policies; 20 of each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch

from concent_warp.deploy.cfg import EvaluateCfg
from concent_warp.train.cfg import EnvironmentCfg, PpoCfg, StressCfg, TrainCfg
from concent_warp.train.observation_cfg import SensorErrorsCfg
from concent_warp.train.policy.load import Policy, load_policy
from concent_warp.train.reset_cfg import ResetCfg
from concent_warp.train.train import train

Known = Literal["perception", "physics", "policy"]
Vector = tuple[float, float, float]
NONE: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Case:
    """One world and policy whose trials fail for a known reason."""

    name: str
    cause: Known
    shift: Vector = NONE
    """Error of tracked positions [m]."""
    turn: Vector = NONE
    """Error of tracked orientations [rad]."""
    biased: tuple[str, ...] = ("block",)
    """Objects with these errors, all where empty."""
    hide: str = ""
    """Hidden effect, name=value."""
    steps: float = 1.0
    """Scale of the command steps."""
    lead: float = 1.0
    """Scale of the leads."""
    noise: float = 0.0
    """Standard deviation of what is added to the weights of the policy, over that of each layer."""
    iterations: int = 0
    """Iterations of a training of its own, 0 for the policy of the package."""

    @property
    def effect(self) -> str:
        """Name of the hidden effect."""
        return self.hide.partition("=")[0]

    def cfg(self) -> EvaluateCfg:
        """Return the settings of its trials."""
        sensors = SensorErrorsCfg(position_bias=self.shift, orientation_bias=self.turn, biased=self.biased)
        return EvaluateCfg(hide=(self.hide,) if self.hide else (), sensors=sensors)

    def policy(self, folder: Path, seed: int) -> Policy:
        """Return its policy; one that is trained for it is kept in a folder."""
        policy = load_policy("shape_sorter")
        if self.iterations:
            policy = _trained(policy, folder / f"{self.name}_{seed}", self.iterations, seed)
        if self.noise:
            policy = _disturbed(policy, self.noise, seed)
        return policy.scaled(self.steps, self.lead)


def _trained(policy: Policy, folder: Path, iterations: int, seed: int) -> Policy:
    """Return a policy trained for a few iterations of 64 worlds."""
    if not (folder / "checkpoint.pt").is_file():
        environment: EnvironmentCfg = replace(policy.run.cfg.environment, worlds=64, engine="mujoco")
        reset: ResetCfg = replace(environment.reset, states=128)
        cfg = TrainCfg(
            environment=replace(environment, reset=reset), ppo=PpoCfg(iterations=iterations), seed=seed,
            stress=StressCfg(every=0),
        )  # fmt: skip
        train(policy.run.model, policy.run.recording, cfg, events=policy.run.events, out=folder, device="cpu")
    return load_policy(folder)


def _disturbed(policy: Policy, noise: float, seed: int) -> Policy:
    """Return a policy with noise added to its weights."""
    generator = torch.Generator().manual_seed(seed)
    actor = dict(policy.weights["actor_state_dict"])
    for name, weights in actor.items():
        if name.startswith("mlp") and name.endswith("weight"):
            actor[name] = weights + noise * weights.std() * torch.randn(weights.shape, generator=generator)
    return replace(policy, weights={**policy.weights, "actor_state_dict": actor})


def _perception() -> list[Case]:
    """Return the cases of biased perception."""
    shifts: list[tuple[Vector, tuple[str, ...]]] = [
        ((0.007, 0, 0), ("block",)), ((0.008, 0, 0), ("block",)), ((0.009, 0, 0), ("block",)),
        ((0.010, 0, 0), ("block",)), ((-0.007, 0, 0), ("block",)), ((-0.008, 0, 0), ("block",)),
        ((-0.009, 0, 0), ("block",)), ((-0.010, 0, 0), ("block",)), ((0, 0, -0.009), ()), ((0, 0, -0.010), ()),
        ((0, 0, -0.012), ()), ((0.008, 0.003, 0), ("block",)), ((-0.008, -0.003, 0), ("block",)),
        ((0.008, 0, 0.003), ("block",)),
    ]  # fmt: skip
    turns: tuple[Vector, ...] = (
        (0, 0, 0.13), (0, 0, 0.15), (0, 0, 0.18), (0, 0, 0.2), (0, 0.12, 0), (0, 0.15, 0),
    )  # fmt: skip
    return [
        *(Case(f"shift {k}", "perception", shift=shift, biased=biased) for k, (shift, biased) in enumerate(shifts)),
        *(Case(f"turn {k}", "perception", turn=turn) for k, turn in enumerate(turns)),
    ]


HIDDEN = {
    "joint_friction": (3, 6),
    "stribeck_friction": (4, 6),
    "load_friction": (0.3, 0.5),
    "joint_damping": (60, 90),
    "gravity_compensation": (0.2, 0.3),
    "actuator_delay": (0.15, 0.2),
    "actuator_lag": (0.2, 0.3),
    "actuator_gain": (0.2, 0.15),
    "backlash": (0.015, 0.02),
    "joint_compliance": (0.01, 0.015),
}
"""Hidden effects with two magnitudes each, in the unit of their main parameter."""


def cases() -> list[Case]:
    """Return all 60 cases."""
    physics = [Case(f"{n}={v:g}", "physics", hide=f"{n}={v:g}") for n, both in HIDDEN.items() for v in both]
    weak = [
        *(Case(f"steps x {s:g}", "policy", steps=s) for s in (0.1, 0.15, 0.18, 0.2, 0.22, 0.25)),
        *(Case(f"leads x {s:g}", "policy", lead=s) for s in (0.08, 0.1, 0.12, 0.15)),
        *(Case(f"weights + {s:g}", "policy", noise=s) for s in (0.4, 0.5, 0.6, 0.7, 0.8)),
        *(Case(f"trained for {n}", "policy", iterations=n) for n in (2, 5, 10, 15, 20)),
    ]
    return [*_perception(), *physics, *weak]
