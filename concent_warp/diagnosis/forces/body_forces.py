"""The unexplained force and torque on a free body: what they depend on, and where they act in each phase."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from concent_warp.comparison.phases import FREE, REST
from concent_warp.diagnosis.forces.cfg import LocateForcesCfg
from concent_warp.diagnosis.forces.contact_state import BETWEEN, BodyWindows, body_windows
from concent_warp.diagnosis.forces.dependence import blocks_of, dependences, min_share
from concent_warp.diagnosis.forces.features import body_force_features, body_torque_features
from concent_warp.diagnosis.forces.force_data import BodyForce, ForceSeries, PhaseForce
from concent_warp.diagnosis.forces.point_of_action import force_place
from concent_warp.diagnosis.forces.wrench import Wrenches, joined, steady_force, wrenches

if TYPE_CHECKING:
    from concent_warp.diagnosis.forces.window_forces import Windows
    from concent_warp.estimation.signals import MeasuredBody
    from concent_warp.estimation.state_estimator import StateEstimator
    from concent_warp.model import Model


@dataclass(frozen=True)
class BodyRecord:
    """A body in one demonstration; K windows, n of them valid."""

    motion: StateEstimator
    windows: Windows
    body: MeasuredBody
    state: BodyWindows
    valid: np.ndarray
    """Windows whose forces are known, shape (K,) bool."""
    seen: Wrenches
    """Wrenches in these, n of them."""

    @property
    def phase(self) -> np.ndarray:
        """Phases of the valid windows, shape (n,)."""
        return self.state.phase[self.valid]


def _body_records(
    name: str, motions: Sequence[StateEstimator], windows: Sequence[Windows], cfg: LocateForcesCfg
) -> list[BodyRecord]:
    """Return a body in each demonstration in which it was measured."""
    found = [
        (motion, window, body, body_windows(motion, window, body, cfg.contact))
        for motion, window in zip(motions, windows, strict=True)
        for body in motion.bodies
        if body.name == name
    ]
    turned = all(body.orientation is not None for _, _, body, _ in found)
    counts = [len(window.start) for _, window, _, _ in found]
    block = np.split(blocks_of(counts, cfg.dependence), np.cumsum(counts)[:-1])
    parts = []
    for (motion, window, body, state), labels in zip(found, block, strict=True):
        dofs = slice(body.dof, body.dof + 6)
        force, covariance = window.force[:, dofs], window.covariance[:, dofs, dofs]
        # Where model and object come to rest at different times, friction acts in one of the two only.
        valid = np.isfinite(force[:, : 6 if turned else 3]).all(axis=1) & np.asarray(state.phase != BETWEEN)
        seen = wrenches(force, covariance, state, labels, valid, turned=turned, min_visible=cfg.place.min_visible)
        parts.append(BodyRecord(motion, window, body, state, valid, seen))
    return parts


def body_force(
    model: Model, name: str, motions: Sequence[StateEstimator], windows: Sequence[Windows], cfg: LocateForcesCfg
) -> BodyForce:
    """Return the unexplained force on a free body."""
    parts = _body_records(name, motions, windows, cfg)
    everything = joined([part.seen for part in parts])
    forces, torques = [], []
    for part in parts:
        acceleration = part.motion.states(part.windows.time).qacc[:, part.body.dof : part.body.dof + 3]
        along, about = body_force_features(part.state, acceleration, name), body_torque_features(part.state, name)
        forces.append({n: f[part.valid] for n, f in along.items()})
        torques.append({n: f[part.valid] for n, f in about.items()})
    touches = any(touch for part in parts for touch in part.state.touches)
    spread = np.sqrt(np.einsum("nii->n", everything.covariance[:, 3:, 3:]) / 3) * everything.size
    force, torque = (
        dependences(
            values,
            std,
            _projected(sight, tables),
            everything.block,
            cfg.seed,
            cfg.dependence,
            in_contact=touches,
        )
        for values, std, sight, tables in (
            (everything.force, everything.std, everything.free[:, :3, :3], forces),
            (everything.torque, spread, everything.free[:, 3:, 3:], torques),
        )
    )
    phases = _body_phases(model, parts, cfg)
    values = [force.p, torque.p, *(phase.p for phase in phases)]
    expected = np.einsum("nii->n", everything.covariance[:, :3, :3])
    square = (everything.force**2).sum(axis=1)
    some = len(square) > 0
    return BodyForce(
        body=name,
        rms=float(np.sqrt(square.mean())) if some else np.nan,
        noise=float(np.sqrt(expected.mean())) if some else np.nan,
        ratio=float(np.sqrt(np.mean(square / np.maximum(expected, 1e-300)))) if some else np.nan,
        p=min(1.0, min(values) * len(values)),
        significant=False,
        force=force,
        torque=torque,
        phases=tuple(sorted(phases, key=lambda phase: phase.p)),
        series=tuple(
            ForceSeries(part.windows.demonstration, part.windows.time[part.valid], part.seen.force, part.seen.std)
            for part in parts
        ),
    )


def _projected(sight: np.ndarray, tables: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return the visible part of features (n, 3) of several demonstrations together."""
    together = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    return {name: np.einsum("nij,nj->ni", sight, value) for name, value in together.items()}


def _body_phases(model: Model, parts: Sequence[BodyRecord], cfg: LocateForcesCfg) -> list[PhaseForce]:
    """Return the steady force and its place in each phase but rest, which shows no forces."""
    names = {str(phase) for part in parts for phase in part.phase} - {REST}
    found = [_body_phase(model, parts, phase, cfg) for phase in sorted(names)]
    return [phase for phase in found if phase is not None]


def _body_phase(model: Model, parts: Sequence[BodyRecord], phase: str, cfg: LocateForcesCfg) -> PhaseForce | None:
    """Return the steady force and its place in one phase; None with too few windows, or where contacts hide it."""
    chosen = [np.asarray(part.phase == phase) for part in parts]
    counts = [int(c.sum()) for c in chosen]
    w = joined([part.seen.only(c) for part, c in zip(parts, chosen, strict=True)])
    if sum(counts) < cfg.min_phase_windows or not (w.std > 0).all():
        return None
    w = replace(w, block=blocks_of(counts, cfg.dependence))
    steady = steady_force(w, cfg)
    if steady is None:
        return None
    body, spans, touches = parts[0].body, [], []
    for part, rows in zip(parts, chosen, strict=True):
        spans += _spans_of(part.windows, np.asarray(part.state.phase == phase) & part.valid)
        touches += [part.state.touches[k] for k in np.flatnonzero(part.valid)[rows]]
    stride = parts[0].windows.length / 2
    return PhaseForce(
        phase=phase,
        spans=tuple(spans),
        frame=body.name if steady.frame == "body" else steady.frame,
        vector=steady.vector,
        std=steady.std,
        share=steady.share,
        impulse=w.force.sum(axis=0) * stride / max(len(spans), 1),
        torque=np.einsum("nji,nj->i", w.rotation, w.torque) / len(w.torque),
        p=steady.p,
        smallest_p=steady.smallest_p,
        test=steady.test,
        significant=False,
        place=force_place(model, parts[0].motion.compiled, body.body, w, steady, touches, cfg.place),
        arrow=np.einsum("nji,nj->i", w.rotation, steady.steady) / len(w.force),
    )


def _spans_of(windows: Windows, chosen: np.ndarray) -> list[tuple[str, float, float]]:
    """Return demonstration, start and end [s] of each run of `chosen` windows, shape (K,) bool."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(int))).reshape(-1, 2)
    ends = windows.start + windows.length
    return [(windows.demonstration, float(windows.start[a]), float(ends[b - 1])) for a, b in edges]


def with_significance(found: BodyForce, accepted: bool, cfg: LocateForcesCfg) -> BodyForce:
    """Return a body with its significant phases marked; places of forces that are not significant are dropped."""
    bound = cfg.dependence.level / max(len(found.phases), 1)
    phases = []
    for phase in found.phases:
        least = min_share(cfg.dependence, phase.phase != FREE)
        ok = accepted and phase.p <= bound and phase.share >= least
        phases.append(replace(phase, significant=ok, place=phase.place if ok else None))
    shown = any(phase.significant for phase in phases) or bool(found.force.patterns or found.torque.patterns)
    return replace(found, significant=found.ratio > cfg.significant_ratio or (accepted and shown), phases=tuple(phases))
