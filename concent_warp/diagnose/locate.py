"""Locate what a model lacks: unexplained forces by degree of freedom, and the places on objects where they act."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.diagnose.contact_state import BETWEEN, BodyWindows, body_windows
from concent_warp.diagnose.dependence import LEAST_SHARE, LEAST_SHARE_IN_CONTACT, LEVEL, blocks_of, dependences
from concent_warp.diagnose.features import CONTACT, body_force_features, body_torque_features, joint_features
from concent_warp.diagnose.force_place import force_place
from concent_warp.diagnose.location import DETECTABLE, BodyForce, ForceSeries, JointForce, Location, PhaseForce
from concent_warp.diagnose.measured_motion import BodyMotion, Motion, measured_motion
from concent_warp.diagnose.phases import FREE, REST
from concent_warp.diagnose.shooting import WindowCfg, Windows, window_forces
from concent_warp.diagnose.wrench import Wrenches, joined, steady_force, wrenches
from concent_warp.simulate.select import EngineName, make_engine

if TYPE_CHECKING:
    from concent_warp.model import Model
    from concent_warp.recording.recording import Recording

FEWEST_WINDOWS = 3
"""Windows that make a phase."""
SELDOM = 0.05
"""Share of the time below which a joint's contact is neglected."""
SHORT_BLOCK, LONG_PHASE = 2, 48
"""Windows in a block of a phase with fewer windows than the second number."""


def locate(
    model: Model,
    recording: Recording,
    engine: EngineName = "auto",
    *,
    cfg: WindowCfg | None = None,
    demonstrations: Sequence[str] | None = None,
) -> Location:
    """Find where a model lacks forces.

    Args:
        model: The model.
        recording: What was commanded and measured.
        engine: Which engine simulates, see `make_engine`.
        cfg: How demonstrations are cut into windows.
        demonstrations: Names of those to use; None takes all.

    Raises:
        RecordingError: There is no such demonstration, or nothing in it that a force could be told from.
        EngineError: The model cannot be simulated.
    """
    cfg = cfg or WindowCfg()
    simulator = make_engine(engine, model)
    chosen = recording.only(demonstrations or ()).demonstrations
    motions = [measured_motion(model, d, simulator) for d in chosen]
    if cfg.length is None:
        # One length for all, so that their forces can be taken together.
        cfg = replace(cfg, length=max(min(max(0.1, 8 * motion.period), 0.3) for motion in motions))
    windows = [window_forces(d.name, simulator, m, cfg) for d, m in zip(chosen, motions, strict=True)]
    features = [joint_features(w, m) for w, m in zip(windows, motions, strict=True)]
    joints = [joint_force(name, unit, dof, windows, features, cfg) for name, unit, dof in all_joints(motions)]
    compiled = simulator.compiled
    bodies = [body_force(model, compiled, name, motions, windows, cfg) for name in all_bodies(motions)]
    accepted = holm([f.p for f in joints] + [f.p for f in bodies])
    joints = [
        replace(f, significant=ok and bool(f.dependences.patterns))
        for f, ok in zip(joints, accepted[: len(joints)], strict=True)
    ]
    bodies = [judged(f, ok) for f, ok in zip(bodies, accepted[len(joints) :], strict=True)]
    joints.sort(key=lambda f: (f.p, -f.rms / f.noise if f.noise else 0.0))
    bodies.sort(key=lambda f: (f.p, -f.rms / f.noise if f.noise else 0.0))
    return Location(windows[0].length, tuple(joints), tuple(bodies))


def all_joints(motions: Sequence[Motion]) -> list[tuple[str, str, int]]:
    """Return name, unit of force and degree of freedom of the joints measured in any demonstration."""
    return sorted(
        {(j.name, "N m" if j.unit == "rad" else "N", j.dof) for m in motions for j in m.joints}, key=lambda j: j[2]
    )


def all_bodies(motions: Sequence[Motion]) -> list[str]:
    """Return the names of the free bodies measured in any demonstration."""
    return list(dict.fromkeys(b.name for m in motions for b in m.bodies))


def joint_force(
    name: str,
    unit: str,
    dof: int,
    windows: Sequence[Windows],
    features: Sequence[Mapping[str, Mapping[str, np.ndarray]]],
    cfg: WindowCfg,
) -> JointForce:
    """Return the unexplained force of a joint, its features in each demonstration given."""
    parts = [(w, f[name]) for w, f in zip(windows, features, strict=True) if name in f]
    force = np.concatenate([w.force[:, dof] for w, _ in parts])
    std = np.concatenate([w.std[:, dof] for w, _ in parts])
    names = [n for n in parts[0][1] if all(n in f for _, f in parts)]
    table = {n: np.concatenate([f[n] for _, f in parts]) for n in names}
    block = blocks_of([len(w.start) for w, _ in parts])
    touches = float(np.mean(table.get(CONTACT, 0.0))) > SELDOM
    least = LEAST_SHARE_IN_CONTACT if touches else LEAST_SHARE
    found = dependences(force[:, None], std, table, block, cfg.seed, least)
    valid = np.isfinite(force) & (std > 0)
    return JointForce(
        joint=name,
        unit=unit,
        rms=root_mean_square(force[valid]),
        noise=root_mean_square(std[valid]),
        detectable=detectable(std[valid], least),
        p=found.p,
        significant=False,
        dependences=found,
        series=tuple(ForceSeries(w.demonstration, w.time, w.force[:, dof], w.std[:, dof]) for w, _ in parts),
    )


def detectable(std: np.ndarray, share: float) -> float:
    """Return the smallest steady force that would be seen in windows with errors `std` (n,); NaN without any.

    It stands out from their mean's error, and makes a `share` of all forces.
    """
    if not len(std):
        return np.nan
    precision = float((1 / std**2).sum())
    return max(DETECTABLE, float(np.sqrt(share / (1 - share) * len(std)))) / float(np.sqrt(precision))


def body_force(
    model: Model,
    compiled: mujoco.MjModel,
    name: str,
    motions: Sequence[Motion],
    windows: Sequence[Windows],
    cfg: WindowCfg,
) -> BodyForce:
    """Return the unexplained force on a free body."""
    parts: list[tuple[Motion, Windows, BodyMotion, BodyWindows]] = []
    for motion, window in zip(motions, windows, strict=True):
        for body in motion.bodies:
            if body.name == name:
                parts.append((motion, window, body, body_windows(motion, window, body)))
    counts = [len(window.start) for _, window, _, _ in parts]
    block = np.split(blocks_of(counts), np.cumsum(counts)[:-1])
    turned = all(body.orientation is not None for _, _, body, _ in parts)
    seen: list[Wrenches] = []
    valid: list[np.ndarray] = []
    for (_, window, body, state), labels in zip(parts, block, strict=True):
        dofs = slice(body.dof, body.dof + 6)
        force, covariance = window.force[:, dofs], window.covariance[:, dofs, dofs]
        seen.append(wrenches(force, covariance, state, labels, turned=turned))
        valid.append(np.asarray(np.isfinite(force[:, : 6 if turned else 3]).all(axis=1)))
    everything = joined(seen)
    force_features, torque_features = [], []
    for (motion, window, body, state), ok in zip(parts, valid, strict=True):
        acceleration = motion.acceleration(window.time)[:, body.dof : body.dof + 3]
        force_features.append({n: f[ok] for n, f in body_force_features(state, acceleration, name).items()})
        torque_features.append({n: f[ok] for n, f in body_torque_features(state, name).items()})
    spread = np.sqrt(np.einsum("nii->n", everything.covariance[:, 3:, 3:]) / 3) * everything.size
    touches = any(len(state.touches[k]) for _, _, _, state in parts for k in range(len(state.touches)))
    least = LEAST_SHARE_IN_CONTACT if touches else LEAST_SHARE
    along, about = (
        dependences(values, std, projected(sight, tables), everything.block, cfg.seed, least)
        for values, std, sight, tables in (
            (everything.force, everything.std, everything.free[:, :3, :3], force_features),
            (everything.torque, spread, everything.free[:, 3:, 3:], torque_features),
        )
    )
    phases = body_phases(model, compiled, parts, seen, valid, cfg)
    values = [along.p, about.p, *(phase.p for phase in phases)]
    return BodyForce(
        body=name,
        rms=root_mean_square(np.linalg.norm(everything.force, axis=1)),
        noise=float(np.sqrt(np.einsum("nii->n", everything.covariance[:, :3, :3]).mean())) if len(spread) else np.nan,
        p=min(1.0, min(values) * len(values)),
        significant=False,
        force=along,
        torque=about,
        phases=tuple(sorted(phases, key=lambda phase: phase.p)),
        series=tuple(
            ForceSeries(window.demonstration, window.time[ok], w.force, w.std)
            for (_, window, _, _), w, ok in zip(parts, seen, valid, strict=True)
        ),
    )


def projected(sight: np.ndarray, tables: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return features (n, 3) of several demonstrations together, as far as contacts leave them to be seen."""
    joined_up = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    return {name: np.einsum("nij,nj->ni", sight, value) for name, value in joined_up.items()}


def body_phases(
    model: Model,
    compiled: mujoco.MjModel,
    parts: Sequence[tuple[Motion, Windows, BodyMotion, BodyWindows]],
    seen: Sequence[Wrenches],
    valid: Sequence[np.ndarray],
    cfg: WindowCfg,
) -> list[PhaseForce]:
    """Return the steady force and its place in each phase but rest, which shows no forces."""
    found = []
    names = {str(phase) for _, _, _, state in parts for phase in state.phase} - {REST, BETWEEN}
    for phase in sorted(names):
        chosen = [state.phase[ok] == phase for (_, _, _, state), ok in zip(parts, valid, strict=True)]
        count = sum(int(c.sum()) for c in chosen)
        if count < FEWEST_WINDOWS:
            continue
        size = SHORT_BLOCK if count < LONG_PHASE else None
        counts = [int(c.sum()) for c in chosen]
        w = joined([s.only(c) for s, c in zip(seen, chosen, strict=True)])
        w = replace(w, block=blocks_of(counts) if size is None else blocks_of(counts, size))
        if not (w.std > 0).all():
            continue
        steady = steady_force(w, cfg.seed)
        if steady is None:
            continue
        touches = [
            state.touches[k]
            for (_, _, _, state), c, ok in zip(parts, chosen, valid, strict=True)
            for k in np.flatnonzero(ok)[c]
        ]
        body = parts[0][2]
        local = np.einsum("nji,nj->ni", w.rotation, w.torque)
        spans = []
        for (_, window, _, state), ok in zip(parts, valid, strict=True):
            spans += spans_of(window, (state.phase == phase) & ok)
        stride = parts[0][1].length / 2
        found.append(
            PhaseForce(
                phase=phase,
                spans=tuple(spans),
                frame=body.name if steady.frame == "body" else steady.frame,
                vector=steady.vector,
                std=steady.std,
                share=steady.share,
                impulse=w.force.sum(axis=0) * stride / max(len(spans), 1),
                torque=local.mean(axis=0),
                p=steady.p,
                test=steady.test,
                significant=False,
                place=force_place(model, compiled, body.body, w, steady, touches),
                arrow=np.einsum("nji,nj->i", w.rotation, steady.steady) / len(w.force),
            )
        )
    return found


def spans_of(window: Windows, chosen: np.ndarray) -> list[tuple[str, float, float]]:
    """Return demonstration, start and end [s] of each run of chosen windows."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(int))).reshape(-1, 2)
    ends = window.start + window.length
    return [(window.demonstration, float(window.start[a]), float(ends[b - 1])) for a, b in edges]


def judged(found: BodyForce, accepted: bool) -> BodyForce:
    """Return a body with what is significant told; places of forces that are not are dropped."""
    bound = LEVEL / max(len(found.phases), 1)
    phases = []
    for phase in found.phases:
        ok = (
            accepted
            and phase.p <= bound
            and phase.share >= (LEAST_SHARE if phase.phase == FREE else LEAST_SHARE_IN_CONTACT)
        )
        phases.append(replace(phase, significant=ok, place=phase.place if ok else None))
    shown = any(phase.significant for phase in phases) or bool(found.force.patterns or found.torque.patterns)
    return replace(found, significant=accepted and shown, phases=tuple(phases))


def holm(p: Sequence[float]) -> list[bool]:
    """Return which hypotheses are rejected at `LEVEL` over all of them (Holm, 1979)."""
    accepted = [False] * len(p)
    for rank, i in enumerate(np.argsort(p)):
        if p[i] > LEVEL / (len(p) - rank):
            break
        accepted[i] = True
    return accepted


def root_mean_square(values: np.ndarray) -> float:
    """Return the RMS of values (n,); NaN of none."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan
