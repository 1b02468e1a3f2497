"""Is something at work that no effect can be? A force of no known form, judged like a candidate.

Where accepted effects have taken up only part of what is missing, what they leave may be little more than noise, and
yet depend on place or speed. A force of no known form (`concent_warp.effects.unknown_force`) tells: its sensitivities
are simulated at the final model, and its held-out gain is set against what chance makes of the same force. Its
smoothness follows from the spacing of its bumps; how large it may be is the prior of a Gaussian process in weight space
(Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 2.1), tried at a few sizes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Protocol

import mujoco
import numpy as np

from concent_warp.diagnosis.result import UnknownForceFound
from concent_warp.diagnosis.search.steps import FittedModel, Screened, chance, screen, with_residuals
from concent_warp.effects.effect import Effect
from concent_warp.effects.select import SINGLE, dof_of, free_bodies, name, typical_torque
from concent_warp.effects.unknown_force import UnknownBodyForce, UnknownForce, UnknownJointForce, Way
from concent_warp.fit.effects.cross_validation import FOLDS, HeldOut, block_sums, sign_flip_p
from concent_warp.fit.effects.least_squares import PRIOR
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.replay import commands

BUMPS = 8
"""Over the range of a joint's position or velocity."""
FEWER = 5
"""The same where there are more than `FEW` joints, and over the range of a body's speed."""
FEW = 3
PLACES = 12
"""Bumps over the places where a body was."""
LEAST = 0.03
"""Share of the held-out error from which on the force counts; on data that lack nothing it stays near a hundredth."""
FORM = 0.01
"""Share of all that the first model lacked from which on it counts: the form of an effect that is there is right only
to about a tenth, a hundredth in squares."""
SHARES = (0.02, 0.1, 0.5)
"""Shares of the error that the force is expected to explain before it is tried."""
GENTLE = 0.1
"""Typical force on a body over its weight."""
ARM = 0.05
"""Lever of the typical torque on a body [m]."""


class Settings(Protocol):
    """What of the settings of a diagnosis matters here, see `concent_warp.diagnosis.diagnose.DiagnoseCfg`."""

    @property
    def level(self) -> float:
        """Probability of finding a force where there is none."""
        ...

    @property
    def adequate(self) -> float:
        """Residual over noise beyond which a model is known not to explain the data."""
        ...

    @property
    def draws(self) -> int:
        """Data sets without a force that tell what chance reaches."""
        ...

    @property
    def seed(self) -> int:
        """Of these."""
        ...


Results = Callable[[Callable[..., Screened], Sequence[tuple[Any, ...]]], Iterable[Screened]]
"""Does independent pieces of work, a function and the arguments of each, and gives their results in order."""


def unknown_force(nodes: Sequence[FittedModel], cfg: Settings, results: Results) -> UnknownForceFound | None:
    """Return a force of no known form that explains what effects do not; None where there is none beyond chance.

    It is looked for in what the last model leaves, unless that is little more than noise; and, where several effects
    had to be added, in what each of them found: there it must explain more than the effect that was added.
    Where the last model leaves much more than noise none is needed to tell that something is missing.

    Args:
        nodes: The first model and those after each addition.
        cfg: Settings.
        results: See `Results`.
    """
    first, last = nodes[0], nodes[-1]
    runs = all("mujoco" in added.effect.engines for added in last.model.effects)
    if last.ratio > cfg.adequate or not runs:
        return None
    lacked = max(max(first.ratio, last.ratio) ** 2 - 1, LEAST)
    if last.ratio**2 >= 1 + LEAST and (found := _best_force(last, None, lacked, cfg, results)) is not None:
        return found
    effects = [len(n.model.effects) for n in nodes]
    if any(after <= before for before, after in pairwise(effects)):
        return None  # some were left out again: what each found is not what the last ones explain
    for before, after in reversed(list(pairwise(nodes[1:]))):
        if (found := _best_force(before, after, lacked, cfg, results)) is not None:
            return found
    return None


def _best_force(
    base: FittedModel, rival: FittedModel | None, lacked: float, cfg: Settings, results: Results
) -> UnknownForceFound | None:
    """Return the force that explains most of what a node leaves.

    Args:
        base: The node.
        rival: One with an effect more, that the force must beat.
        lacked: What the first model left beyond the noise, as a mean of squared residuals over noise.
        cfg: Settings.
        results: See `Results`.
    """
    base = _dealt_in_turn(replace(base, engine="mujoco"))
    left = base.errors if rival is None else _dealt_in_turn(rival).errors
    instead = 1 - float(left.sum() / base.errors.sum())
    screened = list(results(screen, [(base, force) for force in _forces(base)]))
    if not screened:
        return None
    tried = [_weighed(base, s, share) for s in screened for share in SHARES]
    tried += [_together(base, screened, share) for share in SHARES]
    errors = [_held_out(base, s) for s in tried]
    gains = [1 - float(e.sum() / base.errors.sum()) for e in errors]
    best = int(np.argmax(gains))
    more = gains[best] - instead
    share = more * base.ratio**2 / lacked
    if more < LEAST or share < FORM:
        return None
    null = chance(base, tried, cfg.draws, cfg.seed)
    p = float((1 + np.sum(null >= gains[best])) / (len(null) + 1))
    if rival is not None:
        p = max(p, sign_flip_p(left - errors[best], np.random.default_rng(cfg.seed)))
    if p > cfg.level:
        return None
    # Several forces at once are named by the one that explains most by itself.
    force = tried[int(np.argmax(gains[: len(SHARES) * len(screened)]))].effect
    assert isinstance(force, UnknownForce)
    return UnknownForceFound(force.words, gains[best], p, min(share, 1.0), None if rival is None else instead)


def _held_out(base: FittedModel, s: Screened) -> np.ndarray:
    """Return the held-out error of each block, shape (B,), after a linear step with the sensitivities."""
    pieces = with_residuals(s.pieces, base.pieces)
    return HeldOut(block_sums(pieces, base.blocks, base.limit), base.blocks).own()


def _dealt_in_turn(base: FittedModel) -> FittedModel:
    """Return a node whose blocks are dealt to the folds in turn, even where its folds are whole demonstrations.

    A force of no known form says nothing of places where it was not seen, and few throws go where others went.
    """
    count = base.blocks.count
    blocks = replace(base.blocks, fold=np.arange(count) % min(FOLDS, count))
    errors = HeldOut(block_sums(base.pieces, blocks, base.limit), blocks).own()
    return replace(base, blocks=blocks, errors=errors)


def _weighed(base: FittedModel, s: Screened, share: float) -> Screened:
    """Return a force whose bumps are each expected to explain as much, together a share of the error."""
    own = base.pieces[0].jacobian.shape[1]
    square = np.sum([(piece.jacobian[:, own:] ** 2).sum(axis=0) for piece in s.pieces], axis=0)
    seen = square > 1e-9 * max(float(np.max(square)), 1e-30)
    each = share * base.errors.sum() / max(int(seen.sum()), 1)
    factor = np.where(seen, np.sqrt(each / np.maximum(square, 1e-30)) / PRIOR, 0.0)
    scale = np.concatenate([np.ones(own), factor])
    return replace(s, pieces=tuple(replace(piece, jacobian=piece.jacobian * scale) for piece in s.pieces))


def _together(base: FittedModel, screened: Sequence[Screened], share: float) -> Screened:
    """Return all forces at once, each expected to explain as much, together a share of the error."""
    own = base.pieces[0].jacobian.shape[1]
    parts = [_weighed(base, s, share / len(screened)).pieces for s in screened]
    pieces = tuple(
        replace(same[0], jacobian=np.hstack([same[0].jacobian[:, :own], *(p.jacobian[:, own:] for p in same)]))
        for same in zip(*parts, strict=True)
    )
    return replace(screened[0], pieces=pieces)


def _forces(base: FittedModel) -> list[Effect]:
    """Return the forces that are tried: on all joints by position, by velocity; on each free body in several ways."""
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
        low, high = np.percentile(path[:, of], [0.5, 99.5], axis=0)
        kept = high - low > 1e-6
        if not np.any(kept):
            continue
        count = BUMPS if np.count_nonzero(kept) <= FEW else FEWER
        centre = np.linspace(low[kept], high[kept], count, axis=1)
        ids = joints[kept]
        law = UnknownJointForce(of[kept], dof_of(m, ids), centre, typical_torque(m, ids), moving=moving)
        found.append(UnknownForce(f"a force that depends on {words} of {_listed(m, ids)}", law))
    for body in free_bodies(m):
        found += _body_forces(m, body, qpos, qvel)
    return found


def _body_forces(m: mujoco.MjModel, body: int, qpos: np.ndarray, qvel: np.ndarray) -> list[Effect]:
    """Return the forces on a free body that was at positions (T, nq) with velocities (T, nv)."""
    joint = int(m.body_jntadr[body])
    place, dof = int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])
    force = GENTLE * float(m.body_subtreemass[body]) * max(float(np.linalg.norm(m.opt.gravity)), 1.0)
    where, speed = qpos[:, place : place + 3], np.linalg.norm(qvel[:, dof : dof + 3], axis=1)
    rate = np.linalg.norm(qvel[:, dof + 3 : dof + 6], axis=1)
    centre, width = _spread_out(where)
    laid: list[tuple[str, Way, np.ndarray, float, float]] = []
    if width > 1e-4:
        laid.append(("a force that depends on the place", "field", centre, width, force))
        laid.append(("a resistance that depends on the place", "brake", centre, width, force))
    resisted: tuple[tuple[str, Way, np.ndarray, float], ...] = (
        ("a resistance that depends on the speed", "drag", speed, force),
        ("a resistance that depends on the rate of turning", "turning", rate, ARM * force),
    )
    for words, way, values, scale in resisted:
        high = float(np.percentile(values, 99.5))
        if high > 1e-3:
            laid.append((words, way, np.linspace(0, high, FEWER)[:, None], high / (FEWER - 1), scale))
    label = name(m, mujoco.mjtObj.mjOBJ_BODY, body) or f"body {body}"
    return [
        UnknownForce(f"{words} of {label}", UnknownBodyForce(body, place, dof, c, w, s, way))
        for words, way, c, w, s in laid
    ]


def _spread_out(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return up to `PLACES` of some points (T, 3) far from one another (farthest first), and how far [m]."""
    chosen = [points[np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1))]]
    distance = np.linalg.norm(points - chosen[0], axis=1)
    width = 0.0
    for _ in range(PLACES - 1):
        farthest = int(np.argmax(distance))
        width = float(distance[farthest])
        if width < 1e-4:
            break
        chosen.append(points[farthest])
        distance = np.minimum(distance, np.linalg.norm(points - points[farthest], axis=1))
    return np.array(chosen), width


def _visited(base: FittedModel, m: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the states that the node's model goes through, positions (T, nq) and velocities (T, nv)."""
    engine = MujocoEngine(base.model)
    qpos, qvel = [np.zeros((0, m.nq))], [np.zeros((0, m.nv))]
    for w, offset in zip(base.windows, base.fit.offsets, strict=True):
        steps = max(int(np.ceil((w.end - w.start) / engine.timestep - 1e-9)), 1)
        ctrl = commands(m, w.demonstration, steps, w.start)
        for added in base.model.effects:
            ctrl = added.effect.command(m, ctrl, added.array)
        start, error = w.qpos.copy(), offset * w.spread
        mujoco.mj_integratePos(m, start, error[: m.nv], 1.0)
        variants = Variants(1, qpos=start[None], qvel=(w.qvel + error[m.nv :])[None])
        rollout = engine.run(variants, ctrl, bodies=[]).numpy()
        sane = np.isfinite(rollout.qpos[0]).all(axis=1)
        qpos.append(rollout.qpos[0][sane])
        qvel.append(rollout.qvel[0][sane])
    return np.concatenate(qpos), np.concatenate(qvel)


def _listed(m: mujoco.MjModel, joints: np.ndarray) -> str:
    """Return the names of joints in words."""
    names = [name(m, mujoco.mjtObj.mjOBJ_JOINT, int(j)) or f"joint {int(j)}" for j in joints]
    return names[0] if len(names) == 1 else f"each of {len(names)} joints"
