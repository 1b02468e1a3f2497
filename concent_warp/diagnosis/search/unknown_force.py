"""Test for a force of no known form, which shows that something is missing that no effect of the library explains.

Where accepted effects have explained only part of a discrepancy, the residual may be little more than noise, and yet
depend on position or speed. A force of no known form (`concent_warp.effects.unknown_force`), a sum of radial basis
functions, is tested like a candidate: its sensitivities are simulated at the final model, and its held-out gain is
compared with its null distribution. The spacing of the basis functions sets its smoothness; its size has the prior of a
Gaussian process in weight space (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 2.1),
tried at a few sizes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np

from concent_warp.diagnosis.candidates.candidate import FittedModel, ScreenedCandidate
from concent_warp.diagnosis.candidates.null_distribution import max_gain_under_null, null_p_value
from concent_warp.diagnosis.candidates.screening import screen, with_residuals
from concent_warp.diagnosis.cfg import DiagnoseCfg, UnknownForceCfg
from concent_warp.diagnosis.result import UnknownForceFound
from concent_warp.diagnosis.search.adequacy import discrepancies
from concent_warp.effects.effect import Effect
from concent_warp.effects.select import SINGLE, dof_of, element_name, free_bodies, typical_torque
from concent_warp.effects.unknown_force import UnknownBodyForce, UnknownForce, UnknownJointForce, Way
from concent_warp.fit.effects.cross_validation import sign_flip_p

Results = Callable[[Callable[..., ScreenedCandidate], Sequence[tuple[Any, ...]]], Iterable[ScreenedCandidate]]
"""Runs a task for each tuple of arguments and gives the results in their order."""


def unknown_force(nodes: Sequence[FittedModel], cfg: DiagnoseCfg, results: Results) -> UnknownForceFound | None:
    """Return a force of no known form that explains what effects do not; None where none is significant.

    It is fitted to the residual of the last model, unless that is little more than noise; and, where several effects
    were added, to the residual before each of them but the first: there it must explain more than the effect does.

    Args:
        nodes: The fitted model as given and those after each addition.
        cfg: DiagnoseCfg.
        results: See `Results`.
    """
    first, last, min_gain = nodes[0], nodes[-1], cfg.unknown_force.min_gain
    runs = all("mujoco" in added.effect.engines for added in last.model.effects)
    if not runs:
        return None
    lacked, beside = max(*discrepancies(last, first), min_gain), None
    if last.ratio**2 >= 1 + min_gain:
        beside = _best_force(last, None, lacked, cfg, results)
    effects = [len(n.model.effects) for n in nodes]
    if (beside is not None and not beside.form_error) or any(after <= before for before, after in pairwise(effects)):
        return beside  # where effects were removed again, a residual before one is not what the last ones explain
    for before, after in reversed(list(pairwise(nodes[1:]))):
        found = _best_force(before, after, lacked, cfg, results)
        if found is not None and not found.form_error:
            return found
    return beside


def force_beside(last: FittedModel, cfg: DiagnoseCfg, results: Results) -> UnknownForceFound | None:
    """Return the force of no known form that explains most of what a model leaves, None where none is significant.

    Args:
        last: The fitted model.
        cfg: DiagnoseCfg.
        results: See `Results`.
    """
    return _best_force(last, None, max(*discrepancies(last, last), cfg.unknown_force.min_gain), cfg, results)


def _best_force(
    base: FittedModel, rival: FittedModel | None, lacked: float, cfg: DiagnoseCfg, results: Results
) -> UnknownForceFound | None:
    """Return the force that explains most of a fitted model's residual, None where none is significant.

    Args:
        base: The fitted model.
        rival: The same with one effect more, which the force must beat.
        lacked: Mean squared residual of the first model beyond the noise, over the squared noise [-].
        cfg: DiagnoseCfg.
        results: See `Results`.
    """
    base = with_interleaved_folds(replace(base, engine="mujoco"))
    left = base.errors if rival is None else with_interleaved_folds(rival).errors
    instead = 1 - float(left.sum() / base.errors.sum())
    settings = cfg.unknown_force
    screened = list(results(screen, [(base, force, cfg.search) for force in forces(base, settings)]))
    if not screened:
        return None
    tried = [_with_prior(base, s, share) for s in screened for share in settings.expected_shares]
    tried += [combined(base, screened, share) for share in settings.expected_shares]
    errors = [held_out(base, s) for s in tried]
    gains = [1 - float(e.sum() / base.errors.sum()) for e in errors]
    best = int(np.argmax(gains))
    more = gains[best] - instead
    share = more * base.ratio**2 / lacked
    if more < settings.min_gain:
        return None
    p = null_p_value(max_gain_under_null(base, tried, cfg.null_samples, cfg.seed), gains[best])
    if rival is not None:
        p = max(p, sign_flip_p(left - errors[best], np.random.default_rng(cfg.seed)))
    if p > cfg.significance_level:
        return None
    # Several forces at once are named by the one that explains most by itself.
    force = tried[int(np.argmax(gains[: len(settings.expected_shares) * len(screened)]))].effect
    assert isinstance(force, UnknownForce)
    form_error = share < settings.min_share
    return UnknownForceFound(
        force.words, gains[best], p, min(share, 1.0), None if rival is None else instead, form_error=form_error
    )


def held_out(base: FittedModel, s: ScreenedCandidate) -> np.ndarray:
    """Return the held-out error of each block, shape (B,), after a linear step with the sensitivities."""
    pieces = with_residuals(s.pieces, base.pieces)
    return base.held_out(pieces).own()


def with_interleaved_folds(base: FittedModel) -> FittedModel:
    """Return a fitted model whose blocks are assigned to folds in turn, also where its folds are whole demonstrations.

    A force of no known form predicts nothing at positions that were not visited, and few throws visit the same ones.
    """
    count = base.blocks.count
    blocks = replace(base.blocks, fold=np.arange(count) % min(base.cfg.blocks.folds, count))
    interleaved = replace(base, blocks=blocks)
    return replace(interleaved, errors=interleaved.held_out(base.pieces).own())


def _with_prior(base: FittedModel, s: ScreenedCandidate, share: float) -> ScreenedCandidate:
    """Return a force whose basis functions are expected to explain the same each, together a share of the error."""
    own = base.pieces[0].jacobian.shape[1]
    square = np.sum([(piece.jacobian[:, own:] ** 2).sum(axis=0) for piece in s.pieces], axis=0)
    seen = square > 1e-9 * max(float(np.max(square)), 1e-30)
    each = share * base.errors.sum() / max(int(seen.sum()), 1)
    factor = np.where(seen, np.sqrt(each / np.maximum(square, 1e-30)) / base.cfg.least_squares.prior, 0.0)
    scale = np.concatenate([np.ones(own), factor])
    return replace(s, pieces=tuple(replace(piece, jacobian=piece.jacobian * scale) for piece in s.pieces))


def combined(base: FittedModel, screened: Sequence[ScreenedCandidate], share: float) -> ScreenedCandidate:
    """Return all forces at once, expected to explain the same each, together a share of the error."""
    own = base.pieces[0].jacobian.shape[1]
    parts = [_with_prior(base, s, share / len(screened)).pieces for s in screened]
    pieces = tuple(
        replace(same[0], jacobian=np.hstack([same[0].jacobian[:, :own], *(p.jacobian[:, own:] for p in same)]))
        for same in zip(*parts, strict=True)
    )
    return replace(screened[0], pieces=pieces)


def forces(base: FittedModel, cfg: UnknownForceCfg) -> list[Effect]:
    """Return the forces that are tested: on all joints by position and by velocity, and several on each free body."""
    m = base.model.compile()
    qpos, qvel = _visited(base, m)
    found: list[Effect] = []
    if not len(qpos):
        return found
    joints = np.flatnonzero(np.isin(m.jnt_type, SINGLE))
    for words, of, path, moving in (
        ("the position", m.jnt_qposadr[joints], qpos, False),
        ("the velocity", m.jnt_dofadr[joints], qvel, True),
    ):
        low, high = np.percentile(path[:, of], [cfg.percentile, 100 - cfg.percentile], axis=0)
        kept = high - low > 1e-6
        if not np.any(kept):
            continue
        few = np.count_nonzero(kept) <= cfg.few_joints
        count = cfg.basis_functions if few else cfg.basis_functions_many
        centre = np.linspace(low[kept], high[kept], count, axis=1)
        ids = joints[kept]
        force = UnknownJointForce(of[kept], dof_of(m, ids), centre, typical_torque(m, ids), moving=moving)
        found.append(UnknownForce(f"a force that depends on {words} of {_listed(m, ids)}", force))
    for body in free_bodies(m):
        found += _body_forces(m, body, qpos, qvel, cfg)
    return found


def _body_forces(
    m: mujoco.MjModel, body: int, qpos: np.ndarray, qvel: np.ndarray, cfg: UnknownForceCfg
) -> list[Effect]:
    """Return the forces on a free body that visited positions (T, nq) with velocities (T, nv)."""
    joint = int(m.body_jntadr[body])
    place, dof = int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])
    force = cfg.force_scale * float(m.body_subtreemass[body]) * max(float(np.linalg.norm(m.opt.gravity)), 1.0)
    position, speed = qpos[:, place : place + 3], np.linalg.norm(qvel[:, dof : dof + 3], axis=1)
    rate = np.linalg.norm(qvel[:, dof + 3 : dof + 6], axis=1)
    centre, width = _spread_out(position, cfg.basis_points)
    basis: list[tuple[str, Way, np.ndarray, float, float]] = []
    if width > 1e-4:
        basis.append(("a force that depends on the position", "field", centre, width, force))
        basis.append(("a resistance that depends on the position", "brake", centre, width, force))
    resisted: tuple[tuple[str, Way, np.ndarray, float], ...] = (
        ("a resistance that depends on the speed", "drag", speed, force),
        ("a resistance that depends on the rate of turning", "turning", rate, cfg.lever * force),
    )
    count = cfg.basis_functions_many
    for words, way, values, scale in resisted:
        high = float(np.percentile(values, 100 - cfg.percentile))
        if high > 1e-3:
            basis.append((words, way, np.linspace(0, high, count)[:, None], high / (count - 1), scale))
    label = element_name(m, mujoco.mjtObj.mjOBJ_BODY, body) or f"body {body}"
    return [
        UnknownForce(f"{words} of {label}", UnknownBodyForce(body, place, dof, c, w, s, way, cfg.fade_speed))
        for words, way, c, w, s in basis
    ]


def _spread_out(points: np.ndarray, most: int) -> tuple[np.ndarray, float]:
    """Return at most so many of some points (T, 3) by farthest point sampling, and their spacing [m]."""
    chosen = [points[np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1))]]
    distance = np.linalg.norm(points - chosen[0], axis=1)
    width = 0.0
    for _ in range(most - 1):
        farthest = int(np.argmax(distance))
        width = float(distance[farthest])
        if width < 1e-4:
            break
        chosen.append(points[farthest])
        distance = np.minimum(distance, np.linalg.norm(points - points[farthest], axis=1))
    return np.array(chosen), width


def _visited(base: FittedModel, m: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the states that a fitted model visits, positions (T, nq) and velocities (T, nv)."""
    solver = base.solver()
    courses = solver.p.courses(solver.trials(base.fit.values, base.fit.offsets))
    sane = [np.isfinite(course.qpos).all(axis=1) for course in courses]
    qpos = [np.zeros((0, m.nq)), *(c.qpos[rows] for c, rows in zip(courses, sane, strict=True))]
    qvel = [np.zeros((0, m.nv)), *(c.qvel[rows] for c, rows in zip(courses, sane, strict=True))]
    return np.concatenate(qpos), np.concatenate(qvel)


def _listed(m: mujoco.MjModel, joints: np.ndarray) -> str:
    """Return the names of joints in words."""
    names = [element_name(m, mujoco.mjtObj.mjOBJ_JOINT, int(j)) or f"joint {int(j)}" for j in joints]
    return names[0] if len(names) == 1 else f"each of {len(names)} joints"
