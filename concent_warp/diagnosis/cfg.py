"""Settings of a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DiagnoseCfg:
    """Settings of a diagnosis.

    Example:
        >>> import concent_warp as cw
        >>> cw.DiagnoseCfg(effects=("joint_friction", "joint_damping"), additions=1).additions
        1
    """

    level: float = 0.05
    """Probability of naming an effect where nothing is missing."""
    least_gain: float = 0.05
    """An effect must take away at least this share of the held-out error: less is seen in long recordings, and means
    little."""
    survivors: int = 8
    """Candidates that are fitted, of all that are screened."""
    additions: int = 3
    """Most effects that are added."""
    adequate: float = 1.25
    """Residual over noise up to which a model counts as explaining the data."""
    draws: int = 400
    """Data sets without an effect that tell what chance reaches."""
    effects: tuple[str, ...] = ()
    """Names of the effects to consider; all where empty."""
    window: float | None = None
    """Length of a window [s]; by default as long as the motion allows."""
    jobs: int = -1
    """Processes at a time; -1: one a CPU. Others than joblib's own run them with `joblib.parallel_config`."""
    seed: int = 0
    """Seed of all that is drawn."""
    explain: bool = True
    """Whether to say where the model fails and which experiment would tell more; it takes a while."""
    gradient: bool = False
    """Whether fits of friction, mass and contact stiffness may start from where gradients through Newton lead."""
