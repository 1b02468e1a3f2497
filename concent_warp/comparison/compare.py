"""Models against measurements: how far off each one is, by channel, phase and time, and what a change has gained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from concent_warp.comparison.contact_names import Partners
from concent_warp.comparison.phases import Phase, StageLike, phases_by_body, stage_phases
from concent_warp.comparison.residuals import instrument_noise, residuals
from concent_warp.comparison.result import Comparison
from concent_warp.comparison.worst_spans import ranked, worst_places
from concent_warp.errors import ModelError, RecordingError
from concent_warp.simulate.replay import replay
from concent_warp.simulate.select import EngineName, make_engine

if TYPE_CHECKING:
    from concent_warp.model import Model
    from concent_warp.recording.recording import Recording


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
            there is none in any demonstration, times are not told apart. None takes the ways of moving in the replay
            of the last model instead (`phases_by_body`).
        demonstrations: Names of those to compare on; None takes all.
        seed: Seed of the bootstrap.

    Raises:
        ModelError: There is no model.
        RecordingError: There is no such demonstration, or it measures nothing, or what a model does not.
        EngineError: A model cannot be simulated.
    """
    if not models:
        raise ModelError("there is no model to compare")
    chosen = recording.only(demonstrations or ()).demonstrations
    found, diverged, partners = {}, {}, {}
    moving: dict[str, dict[str | None, tuple[Phase, ...]]] = {}
    last = tuple(models)[-1]
    for name, model in models.items():
        simulator = make_engine(engine, model)
        compiled = model.compile()
        noise = instrument_noise(compiled, recording.demonstrations)
        for d in chosen:
            rollout = replay(model, d, simulator, contacts="all" if name == last else "none").numpy()
            found[name, d.name] = residuals(compiled, rollout, d, noise, model.effects)
            if rollout.diverged[0]:
                bad = ~np.isfinite(rollout.qpos[0]).all(axis=1)
                diverged[name, d.name] = float(rollout.time[np.argmax(bad)] if bad.any() else rollout.time[-1])
            if name == last:
                partners[d.name] = Partners.of_replay(model, compiled, rollout)
                moving[d.name] = phases_by_body(model, compiled, rollout)
    if not any(found.values()):
        raise RecordingError("nothing was measured that could be compared with a model", where=recording.source)
    staged = phases or {}
    if any(map(len, staged.values())):
        moving = {d.name: {None: stage_phases(staged[d.name], d.duration)} for d in chosen if d.name in staged}
    elif phases is not None:
        moving = {}
    spans = {name: by_body[None] for name, by_body in moving.items()}
    places = [
        place
        for d in chosen
        for place in worst_places(found[last, d.name], moving.get(d.name, {None: ()}), partners[d.name], d.name)
    ]
    return Comparison(
        models=tuple(models),
        demonstrations=tuple(d.name for d in chosen),
        residuals=found,
        phases=spans,
        diverged=diverged,
        seed=seed,
        places=ranked(places),
        staged=phases is not None,
    )
