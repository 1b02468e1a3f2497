"""Time step, stiffness, damping and friction slope with which Newton's explicit solver stays stable, and its gradients.

A contact of that solver is a spring with a damper, and friction a damper up to Coulomb's limit. All act explicitly, so
that the stiffest motion of a body bounds the time step. With contacts at r_i from the centre of mass, M the body's
6 x 6 inertia and J_i = [1, -[r_i]x], the largest eigenvalue L of M^-1 sum_i J_i^T J_i is the strength of all
contacts together [1/kg]. The rules are

    dt^2 ke L <= max_spring_number,    dt kd L <= max_damper_number,    dt kf L <= max_damper_number.

A forward run stays stable well beyond the last of them; gradients do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from concent_warp.checks import Count, Positive, Share, TimeStep
from concent_warp.errors import EngineError


@dataclass(frozen=True)
class NewtonCfg:
    """How contacts are simulated in Newton."""

    frequency: Positive = 200.0
    """Natural frequency of a body on its contacts [rad/s]: a resting body sinks by g / frequency^2, 0.2 mm."""
    damping: Positive = 2.0
    """Damping ratio of that motion [-]. Newton's dampers act on approach only: with less of it bodies bounce off, where
    MuJoCo's contacts take the speed out."""
    onset: Positive = 3e-4
    """Depth at which a damper acts in full [m]. One that acts at once makes the motion jump with the step of the first
    touch, and gradients wrong."""
    longest_step: TimeStep = 5e-4
    """Longest time step [s]."""
    shortest_step: TimeStep = 1e-4
    """Shortest time step; a scene that asks for a shorter one is refused [s]."""
    creep: Positive = 0.02
    """Largest speed at which a body creeps although friction should stop it [m/s]."""
    reach: float = 0.004
    """A sphere that comes this near to something, in MuJoCo or as observed, may collide with it [m]."""
    min_contacts: Count = 4
    """Contacts that carry a resting body [-]: they share its stiffness, and at least so many are assumed."""
    min_damping: Share = 0.6
    """Share of `damping` below which a body would bounce [-]."""
    max_spring_number: Positive = 0.5
    """Largest dt^2 ke L [-]: semi-implicit Euler is stable below 4, and accurate well below 1."""
    max_damper_number: Positive = 0.8
    """Largest dt kd L and dt kf L [-]: an explicit damper overshoots from 1 on and is unstable from 2 on."""
    pair_states: Count = 200
    """States of a segment, of those simulated, in which pairs that may collide are searched for [-]."""


@dataclass(frozen=True)
class BodyInertia:
    """Inertia of a simulated body."""

    name: str
    mass: float
    """[kg]."""
    inertia: np.ndarray
    """About the centre of mass, body axes [kg m^2], shape (3, 3)."""
    com: np.ndarray
    """Centre of mass [m], body frame, shape (3,)."""


@dataclass(frozen=True)
class NewtonPhysics:
    """Numbers that satisfy the rules."""

    substeps: int
    """Newton's steps in one of MuJoCo's."""
    timestep: float
    """[s]."""
    stiffness: np.ndarray
    """Of a contact of each body [N/m], shape (D,)."""
    damping: np.ndarray
    """[N s/m], shape (D,)."""
    friction_slope: float
    """Of every contact [N s/m]."""
    onset: float
    """Depth at which damping is full [m]."""


def coupling(body: BodyInertia, points: np.ndarray) -> float:
    """Return how strongly contacts at points (n, 3) [m], body frame, act on a body together: L [1/kg]."""
    arm = points - body.com
    skew = np.zeros((len(arm), 3, 3))
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -arm[:, 2], arm[:, 1], -arm[:, 0]
    skew -= np.swapaxes(skew, 1, 2)
    jacobian = np.concatenate([np.broadcast_to(np.eye(3), skew.shape), -skew], axis=2)
    total = np.einsum("nij,nik->jk", jacobian, jacobian)
    inverse = np.zeros((6, 6))
    inverse[:3, :3], inverse[3:, 3:] = np.eye(3) / body.mass, np.linalg.inv(body.inertia)
    return float(np.abs(np.linalg.eigvals(inverse @ total)).max())


def choose_physics(
    cfg: NewtonCfg,
    timestep: float,
    bodies: Sequence[BodyInertia],
    couplings: Sequence[float],
    friction: float,
    gravity: float,
) -> NewtonPhysics:
    """Return time step, stiffness and damping by the rules.

    Args:
        cfg: Settings.
        timestep: MuJoCo's step, of which Newton's is a part [s].
        bodies: The simulated bodies, D of them.
        couplings: L of each with all contacts that it may have at a time [1/kg].
        friction: Largest friction coefficient [-].
        gravity: [m/s^2].

    Raises:
        EngineError: No time step that is allowed keeps the scene stable.
    """
    mass = np.array([b.mass for b in bodies])
    strength = np.array(couplings)
    stiffness = mass * cfg.frequency**2 / cfg.min_contacts
    damping = 2 * cfg.damping * mass * cfg.frequency / cfg.min_contacts
    first = max(int(np.ceil(timestep / cfg.longest_step - 1e-9)), 1)
    last = int(np.floor(timestep / cfg.shortest_step + 1e-9))
    steps = np.array([timestep / k for k in range(first, max(last, first) + 1)])[:, None]
    limit = cfg.max_damper_number / (steps * strength)
    slope = limit.min(axis=1, keepdims=True)
    reasons = {
        "its contacts are too stiff": steps**2 * stiffness * strength <= cfg.max_spring_number,
        "it would bounce": limit >= cfg.min_damping * damping,
        "it would creep": friction * gravity * mass
        <= cfg.creep * slope * np.maximum(mass * strength, cfg.min_contacts),
    }
    fine = np.logical_and.reduce(list(reasons.values())).all(axis=1)
    if not fine.any():
        why, body = next((w, int((~ok[-1]).argmax())) for w, ok in reasons.items() if not ok[-1].all())
        raise EngineError(
            "Newton cannot simulate this scene stably for gradients",
            where=bodies[body].name,
            expected=f"a time step of at least {1e3 * cfg.shortest_step:g} ms to do",
            found=f"that with {1e3 * steps[-1].item():.3g} ms {why}",
            fix="take fewer spheres or the evolution strategy (--method es)",
        )
    k = int(fine.argmax())
    step = steps[k].item()
    return NewtonPhysics(first + k, step, stiffness, np.minimum(damping, limit[k]), float(limit[k].min()), cfg.onset)
