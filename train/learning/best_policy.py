"""The policy that did best in the stress test of a training, in its checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from concent_warp.errors import TrainError


def chosen_best(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a checkpoint says of the policy that did best in the stress test, as `Trainer.best`.

    Raises:
        TrainError: It is incomplete.
    """
    best = checkpoint.get("best") or {}
    if not best:
        return {}
    if not isinstance(best, Mapping) or not isinstance(best.get("actor_state_dict"), Mapping):
        raise TrainError("the checkpoint's best policy has no weights")
    for name in ("iteration", "successes", "episodes"):
        if not isinstance(best.get(name), int) or best[name] < 0:
            raise TrainError(
                f"{name} of the checkpoint's best policy is no count", expected="at least 0", found=best.get(name)
            )
    return dict(best)


def chosen_weights(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """Return a checkpoint with the policy that did best in the stress test in place of the last one, if there is one.

    Raises:
        TrainError: What it says about that policy is incomplete.
    """
    outcome = chosen_best(checkpoint)
    if not outcome:
        return dict(checkpoint)
    weights = outcome.pop("actor_state_dict")
    kept = {name: value for name, value in checkpoint.items() if name != "best"}
    return {**kept, "actor_state_dict": weights, "stress": outcome}
