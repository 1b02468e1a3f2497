"""Maskers and point trackers by the names that the command line has for them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from concent_warp.errors import ConcentError
from concent_warp.perception.backends.depth import DepthMasker
from concent_warp.perception.backends.features import FeatureTracker
from concent_warp.perception.backends.flow import FlowTracker
from concent_warp.perception.backends.protocols import Masker, PointTracker
from concent_warp.perception.backends.sam2 import Sam2Masker
from concent_warp.perception.backends.tapir import TapirTracker

MaskerName = Literal["none", "depth", "sam2"]
"""Names of maskers."""
PointTrackerName = Literal["none", "flow", "features", "tapir"]
"""Names of point trackers."""


def named_masker(name: MaskerName, weights: Path | None = None, device: str | None = None) -> Masker | None:
    """Return a masker by its name, None for "none".

    Args:
        name: Its name.
        weights: Folder of the weights, for "sam2".
        device: Where networks run; the first CUDA device by default where there is one.

    Raises:
        ConcentError: Weights are missing, or given to what has none.
    """
    if name != "sam2":
        _refuse("--masker-weights", weights, f"--masker {name}", "--masker sam2")
        return DepthMasker() if name == "depth" else None
    if weights is None:
        fix = "give a folder with a checkpoint of SAM 2 in the format of transformers"
        raise ConcentError("--masker sam2 has no weights", expected="--masker-weights FOLDER", fix=fix)
    return Sam2Masker(weights, device=device)


def named_point_tracker(
    name: PointTrackerName,
    checkout: Path | None = None,
    weights: Path | None = None,
    device: str | None = None,
) -> PointTracker | None:
    """Return a point tracker by its name, None for "none".

    Args:
        name: Its name.
        checkout: Folder of the code, for "tapir".
        weights: File of the weights, for "tapir".
        device: Where networks run; the first CUDA device by default where there is one.

    Raises:
        ConcentError: Code or weights are missing, or given to what has none.
    """
    if name != "tapir":
        for option, given in (("--points-checkout", checkout), ("--points-weights", weights)):
            _refuse(option, given, f"--points {name}", "--points tapir")
        return {"flow": FlowTracker, "features": FeatureTracker}[name]() if name != "none" else None
    if checkout is None or weights is None:
        missing = [o for o, v in (("--points-checkout", checkout), ("--points-weights", weights)) if v is None]
        raise ConcentError(
            "--points tapir lacks its code or weights",
            expected="--points-checkout FOLDER --points-weights FILE",
            found=f"no {', '.join(missing)}",
            fix="give a checkout of github.com/google-deepmind/tapnet and its bootstapir_checkpoint_v2.pt",
        )
    return TapirTracker(checkout, weights, device=device)


def _refuse(option: str, given: Path | None, without: str, needs: str) -> None:
    """Raise an error where an option is given that means nothing."""
    if given is not None:
        raise ConcentError(f"{option} means nothing with {without}", expected=needs, found=f"{option} {given}")
