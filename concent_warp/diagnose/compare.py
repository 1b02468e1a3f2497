"""Models against measurements: how far off each one is, by channel, phase and time, and what a change has gained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from concent_warp.diagnose.comparison import FREE, Comparison, Phase
from concent_warp.diagnose.residuals import residuals
from concent_warp.errors import ModelError
from concent_warp.simulate.replay import replay
from concent_warp.simulate.select import EngineName, make_engine

if TYPE_CHECKING:
    from concent_warp.model import Model
    from concent_warp.recording.recording import Demonstration, Recording


class StageLike(Protocol):
    """A named span of time, such as a stage of a contact event sequence."""

    @property
    def name(self) -> str:
        """Name."""
        ...

    @property
    def start(self) -> float:
        """First instant [s]."""
        ...

    @property
    def end(self) -> float:
        """First instant after it [s]."""
        ...


def compare(
    models: Mapping[str, Model],
    recording: Recording,
    engine: EngineName = "auto",
    *,
    phases: Mapping[str, Sequence[StageLike]] | None = None,
    demonstrations: Sequence[str] | None = None,
    seed: int = 0,
) -> Comparison:
    """Replay demonstrations in each model and compare what it predicts with what was measured.

    Each model keeps its own time step, integrator and solver: they are part of it.

    Args:
        models: One or more models by name, the baseline first.
        recording: What was commanded and measured.
        engine: Which engine simulates, see `make_engine`.
        phases: Contact stages by demonstration, as a contact event sequence has them; the same for every model. Where
            there is none in any demonstration, times are not told apart.
        demonstrations: Names of those to compare on; None takes all.
        seed: Seed of the bootstrap.

    Raises:
        ModelError: There is no model.
        RecordingError: There is no such demonstration, or it measures what a model does not.
        EngineError: A model cannot be simulated.
    """
    if not models:
        raise ModelError("there is no model to compare")
    chosen = recording.only(demonstrations or ()).demonstrations
    found, diverged = {}, {}
    for name, model in models.items():
        simulator = make_engine(engine, model)
        compiled = model.compile()
        for d in chosen:
            rollout = replay(model, d, simulator).numpy()
            found[name, d.name] = residuals(compiled, rollout, d)
            if rollout.diverged[0]:
                bad = ~np.isfinite(rollout.qpos[0]).all(axis=1)
                diverged[name, d.name] = float(rollout.time[np.argmax(bad)] if bad.any() else rollout.time[-1])
    staged = phases or {}
    spans = {d.name: spans_of(d, staged[d.name]) for d in chosen if d.name in staged and any(map(len, staged.values()))}
    return Comparison(tuple(models), tuple(d.name for d in chosen), found, spans, diverged, seed)


def spans_of(demonstration: Demonstration, stages: Sequence[StageLike]) -> tuple[Phase, ...]:
    """Return the phases of a demonstration: what comes before its first stage, then its stages."""
    first = stages[0].start if stages else demonstration.duration
    spans = [Phase(FREE, -np.inf, first)] if first > 0 else []
    spans += [Phase(s.name, s.start, s.end) for s in stages]
    spans[-1] = Phase(spans[-1].name, spans[-1].start, np.inf)
    return tuple(spans)
