"""Forces that a model lacks: by degree of freedom, and by the places on objects where they act."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from concent_warp.checks import check_settings
from concent_warp.diagnosis.forces.body_forces import body_force, with_significance
from concent_warp.diagnosis.forces.cfg import LocateForcesCfg
from concent_warp.diagnosis.forces.dependence import blocks_of, dependences, min_share
from concent_warp.diagnosis.forces.features import CONTACT, joint_features
from concent_warp.diagnosis.forces.force_data import ForceSeries, JointForce
from concent_warp.diagnosis.forces.result import UnexplainedForces
from concent_warp.diagnosis.forces.window_forces import Windows, window_forces, window_length
from concent_warp.effects.select import driven_joints
from concent_warp.estimation.state_estimator import StateEstimator, StateEstimatorCfg
from concent_warp.files import write_json
from concent_warp.model import Model, check_inputs
from concent_warp.simulate.select import EngineName, make_engine

if TYPE_CHECKING:
    from concent_warp.recording.recording import Recording


def locate_forces(
    model: Model,
    recording: Recording,
    cfg: LocateForcesCfg | None = None,
    *,
    engine: EngineName = "mujoco",
    out: str | Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> UnexplainedForces:
    """Return the forces that a model lacks: by joint, and by place on each object.

    Args:
        model: The model.
        recording: What was commanded and measured.
        cfg: Settings.
        engine: "mujoco", "warp", or "auto" for MuJoCo-Warp where there is a CUDA device.
        out: JSON file for all figures, SI units.
        progress: Called with the share done, 0..1.

    Raises:
        RecordingError: There is no such demonstration, or nothing in it from which a force could be estimated.
        EngineError: The model cannot be simulated.

    Example:
        >>> import concent_warp as cw
        >>> recording = cw.load_recording(cw.example("servo"))
        >>> forces = cw.locate_forces(cw.Model.from_recording(recording), recording)
        >>> [joint.joint for joint in forces.joints if joint.significant]
        ['hinge']
    """
    cfg = cfg or LocateForcesCfg()
    check_settings(cfg)
    check_inputs(model, recording)
    simulator = make_engine(engine, model)
    chosen = recording.demonstrations
    motions = [StateEstimator.of(model, d, StateEstimatorCfg("smoothing_spline"), engine=simulator) for d in chosen]
    report = progress or _ignore
    report(0.1)
    if cfg.length is None:
        # One length for all, so that their forces can be taken together.
        cfg = replace(cfg, length=max(map(window_length, motions)))
    windows = []
    for k, (d, motion) in enumerate(zip(chosen, motions, strict=True)):
        windows.append(window_forces(d.name, simulator.carrying(d.payloads), motion, cfg))
        report(0.1 + 0.6 * (k + 1) / len(chosen))
    features = [joint_features(w, m, cfg.features) for w, m in zip(windows, motions, strict=True)]
    unknown = _driven_with_a_state(motions[0].compiled)
    shown = [joint for joint in _all_joints(motions) if joint[2] not in unknown]
    joints = [_joint_force(name, unit, dof, windows, features, cfg) for name, unit, dof in shown]
    bodies = [body_force(model, name, motions, windows, cfg) for name in _all_bodies(motions)]
    accepted = _holm([f.p for f in joints] + [f.p for f in bodies], cfg.dependence.level)
    joints = [
        replace(f, significant=f.ratio > cfg.significant_ratio or (ok and bool(f.dependences.patterns)))
        for f, ok in zip(joints, accepted[: len(joints)], strict=True)
    ]
    bodies = [with_significance(f, ok, cfg) for f, ok in zip(bodies, accepted[len(joints) :], strict=True)]
    joints.sort(key=lambda f: (not f.significant, -f.ratio))
    bodies.sort(key=lambda f: (not f.significant, -f.ratio))
    found = UnexplainedForces(windows[0].length, tuple(joints), tuple(bodies), cfg.dependence.level)
    if out is not None:
        write_json(Path(out), found.to_json())
    return found


def _ignore(share: float) -> None:
    """Do nothing with the progress."""
    del share


def _all_joints(motions: Sequence[StateEstimator]) -> list[tuple[str, str, int]]:
    """Return name, unit of force and degree of freedom of the joints measured in any demonstration."""
    return sorted(
        {(j.name, "N m" if j.unit == "rad" else "N", j.dof) for m in motions for j in m.joints}, key=lambda j: j[2]
    )


def _driven_with_a_state(m: mujoco.MjModel) -> set[int]:
    """Return the degrees of freedom that an actuator with a state drives.

    Where a window begins in the middle of a motion, no instrument tells the state of its filter or integrator, and its
    force would be taken for one that the model lacks.
    """
    joints = {j for a in np.flatnonzero(m.actuator_actadr >= 0) for j in driven_joints(m, int(a))}
    return {dof for dof in range(m.nv) if int(m.dof_jntid[dof]) in joints}


def _all_bodies(motions: Sequence[StateEstimator]) -> list[str]:
    """Return the names of the free bodies measured in any demonstration."""
    return list(dict.fromkeys(b.name for m in motions for b in m.bodies))


def _joint_force(
    name: str,
    unit: str,
    dof: int,
    windows: Sequence[Windows],
    features: Sequence[Mapping[str, Mapping[str, np.ndarray]]],
    cfg: LocateForcesCfg,
) -> JointForce:
    """Return the unexplained force of a joint, its features in each demonstration given."""
    parts = [(w, f[name]) for w, f in zip(windows, features, strict=True) if name in f]
    force = np.concatenate([w.force[:, dof] for w, _ in parts])
    std = np.concatenate([w.std[:, dof] for w, _ in parts])
    names = [n for n in parts[0][1] if all(n in f for _, f in parts)]
    table = {n: np.concatenate([f[n] for _, f in parts]) for n in names}
    block = blocks_of([len(w.start) for w, _ in parts], cfg.dependence)
    touches = float(np.mean(table.get(CONTACT, 0.0))) > cfg.max_contact_share
    found = dependences(force[:, None], std, table, block, cfg.seed, cfg.dependence, in_contact=touches)
    valid = np.isfinite(force) & (std > 0)
    return JointForce(
        joint=name,
        unit=unit,
        rms=_root_mean_square(force[valid]),
        noise=_root_mean_square(std[valid]),
        ratio=_root_mean_square(force[valid] / std[valid]),
        detectable=_detectable(std[valid], min_share(cfg.dependence, touches), cfg.detectable_standard_errors),
        p=found.p,
        significant=False,
        dependences=found,
        series=tuple(ForceSeries(w.demonstration, w.time, w.force[:, dof], w.std[:, dof]) for w, _ in parts),
    )


def _detectable(std: np.ndarray, share: float, standard_errors: float) -> float:
    """Return the smallest detectable steady force in windows with errors `std` (n,); NaN without any.

    It exceeds so many standard errors of their mean, and is a `share` of the mean squared force.
    """
    if not len(std):
        return np.nan
    precision = float((1 / std**2).sum())
    return max(standard_errors, float(np.sqrt(share / (1 - share) * len(std)))) / float(np.sqrt(precision))


def _holm(p: Sequence[float], level: float) -> list[bool]:
    """Return which hypotheses are rejected at a level over all of them (Holm, Scand. J. Stat. 6, 1979)."""
    accepted = [False] * len(p)
    for rank, i in enumerate(np.argsort(p)):
        if p[i] > level / (len(p) - rank):
            break
        accepted[i] = True
    return accepted


def _root_mean_square(values: np.ndarray) -> float:
    """Return the RMS of values (n,); NaN of none."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan
