"""Bounds of the settings of a training."""

from __future__ import annotations

from typing import Any

from concent_warp.checks import check_settings
from concent_warp.errors import TrainError


def check_cfg(cfg: Any) -> None:
    """Check the settings of a training, a `TrainCfg`.

    Raises:
        TrainError: A setting is out of bounds.
    """
    check_settings(cfg, TrainError)
    e, p = cfg.environment, cfg.ppo
    if not p.hidden:
        raise TrainError("ppo.hidden is empty", expected="at least one layer")
    if e.stride is not None and e.decimation % e.stride:
        raise TrainError(
            "an action is not a whole number of simulation steps",
            expected=f"a divisor of the decimation, {e.decimation}",
            found=f"stride {e.stride}",
        )
    if e.worlds * p.steps < p.batches:
        raise TrainError(
            "an iteration has fewer environment steps than mini-batches",
            expected=f"at least {p.batches}",
            found=e.worlds * p.steps,
        )
