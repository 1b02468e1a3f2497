"""What a replay in one piece says of a diagnosis, which judges by windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from concent_warp.comparison.compare import CompareCfg, compare
from concent_warp.errors import ConcentError
from concent_warp.simulate.select import EngineName

if TYPE_CHECKING:
    from concent_warp.fit.effects.observation import Window
    from concent_warp.model import Model
    from concent_warp.recording.recording import Recording


@dataclass(frozen=True)
class Replayed:
    """Residual over noise of models that are replayed in one piece, as `concent compare` does.

    The root mean square over the channels of each one's root mean square residual over its noise.
    """

    given: float
    """Of the model as given [-]."""
    better: float
    """Of the model with the accepted effects [-]."""
    window: float
    """Length of the longest window by which the effects were judged [s]."""
    doubtful: bool
    """Whether `better` is so large that the answer says it, see `DiagnoseCfg.doubtful_replay`."""

    def explains(self, share: float) -> bool:
        """Return whether the better model explains a share of the squared residual of the given one above the noise."""
        return self.better**2 - 1 <= (1 - share) * max(self.given**2 - 1, 0.0)

    @property
    def sentence(self) -> str:
        """What a doubtful replay says of the answer."""
        return (
            f"Replayed in one piece the better model is {self.better:.3g} x noise off, the model as given "
            f"{self.given:.3g} x; the effects were judged by windows of at most {self.window:.2g} s. Motion that "
            "amplifies small differences does that, and so does an effect that such windows hardly show: check the "
            "values, or record slower or longer undisturbed motion."
        )

    def to_json(self) -> dict[str, Any]:
        """Return the residuals in plain types."""
        return {"given": self.given, "better": self.better, "window": self.window, "doubtful": self.doubtful}


def replayed(
    given: Model, better: Model, recording: Recording, windows: Sequence[Window], limit: float, engine: EngineName
) -> Replayed | None:
    """Replay two models in one piece; None where that cannot be done, or no channel has a noise.

    Args:
        given: The model as given.
        better: The model with the accepted effects.
        recording: What was commanded and measured.
        windows: By which the effects were judged.
        limit: Residual over noise of `better` above which it is doubtful [-].
        engine: Which engine simulates.
    """
    try:
        found = compare({"given": given, "better": better}, recording, CompareCfg(phases="none"), engine=engine)
    except ConcentError:
        return None
    size: list[float] = []
    for model in ("given", "better"):
        ratios = [found.summarise(model, channel).ratio for channel in found.channels]
        known = [r for r in ratios if r is not None]
        if not known or not np.isfinite(known).all():
            return None
        size.append(float(np.sqrt(np.mean(np.square(known)))))
    longest = max(w.end - w.start for w in windows)
    return Replayed(size[0], size[1], float(longest), size[1] > limit)
