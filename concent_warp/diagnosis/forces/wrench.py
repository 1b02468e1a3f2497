"""The unexplained force and torque on a free body in one phase: size, direction and significance.

Contacts hide forces: the table balances what presses a block onto it. Only the part of a wrench along motions that
lasting contacts leave free is visible, P w with the projector P of `contact_state`; the rest is taken as 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from concent_warp.diagnosis.forces.cfg import LocateForcesCfg
from concent_warp.diagnosis.forces.contact_state import BodyWindows
from concent_warp.diagnosis.forces.dependence import flips

WORLD, SLIP = "world", "sliding"


@dataclass(frozen=True)
class Wrenches:
    """Unexplained wrenches on one body in some windows, world frame, about the body's origin; n windows."""

    force: np.ndarray
    """Visible part of the force [N], shape (n, 3)."""
    torque: np.ndarray
    """Visible part of the torque [N m], shape (n, 3)."""
    covariance: np.ndarray
    """Of force and torque / size, shape (n, 6, 6)."""
    free: np.ndarray
    """Projectors onto the visible part of force and torque / size, shape (n, 6, 6)."""
    size: float
    """Radius that makes torques comparable with forces [m]."""
    rotation: np.ndarray
    """Body to world, shape (n, 3, 3)."""
    sliding: np.ndarray
    """Velocity at the contact [m/s], shape (n, 3)."""
    block: np.ndarray
    """Block of each window for sign flips, shape (n,)."""
    turned: bool
    """Whether torques are known: the orientation was measured."""
    min_visible: float
    """Share of a direction's length that must be visible for it to count."""

    @property
    def std(self) -> np.ndarray:
        """Standard deviation of a visible component of the force [N], shape (n,)."""
        seen = np.einsum("nii->n", self.free[:, :3, :3])
        spread = np.einsum("nii->n", self.covariance[:, :3, :3])
        return np.sqrt(spread / np.maximum(seen, self.min_visible))

    def only(self, chosen: np.ndarray) -> Wrenches:
        """Return some of the windows."""
        rows = {name: value[chosen] for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        return replace(self, **rows)


def joined(parts: list[Wrenches]) -> Wrenches:
    """Return the windows of several demonstrations together."""
    rows = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name, value in vars(parts[0]).items()
        if isinstance(value, np.ndarray)
    }
    return replace(parts[0], **rows)


def wrenches(
    force: np.ndarray,
    covariance: np.ndarray,
    state: BodyWindows,
    block: np.ndarray,
    valid: np.ndarray,
    *,
    turned: bool,
    min_visible: float,
) -> Wrenches:
    """Return the visible part of residual generalised forces of a free joint.

    Args:
        force: Force in the world frame and torque in the body frame, about the origin, shape (K, 6).
        covariance: Theirs, shape (K, 6, 6).
        state: What the body does in these windows.
        block: Blocks, shape (K,).
        valid: Which windows to take, shape (K,) bool.
        turned: Whether the orientation was measured.
        min_visible: Share of a direction's length that must be visible for it to count.
    """
    force, covariance = np.nan_to_num(force[valid]), covariance[valid]
    rotation = state.rotation[valid]
    change = np.zeros((len(force), 6, 6))
    change[:, :3, :3] = np.eye(3)
    change[:, 3:, 3:] = rotation / state.size
    free = state.free[valid].copy()
    if not turned:
        free[:, 3:], free[:, :, 3:] = 0, 0
    through = free @ change
    seen = np.einsum("kij,kj->ki", through, force)
    return Wrenches(
        force=seen[:, :3],
        torque=seen[:, 3:] * state.size,
        covariance=through @ covariance @ through.transpose(0, 2, 1),
        free=free,
        size=state.size,
        rotation=rotation,
        sliding=state.sliding[valid],
        block=block[valid],
        turned=turned,
        min_visible=min_visible,
    )


@dataclass(frozen=True)
class SteadyForce:
    """The force that is the same in all windows of a phase, in the frame in which it is steadiest."""

    frame: str
    """"world", "body", or "sliding": along the velocity at the contact."""
    vector: np.ndarray
    """[N] in that frame, shape (3,); along the sliding direction the first component."""
    std: np.ndarray
    """Of the vector [N], shape (3,)."""
    each: np.ndarray
    """The force in every window: the steady part, and of the rest what is more than noise [N], world frame, (n, 3)."""
    taken: float
    """Share of the rest, noise included, that `each` holds, 0..1."""
    steady: np.ndarray
    """The steady part in every window [N], world frame, shape (n, 3)."""
    share: float
    """Share of the weighted square of the seen forces that it explains."""
    scale: float
    """Scatter about it over what the noise leaves, at least 1."""
    p: float
    """p-value [-]."""
    smallest_p: float
    """Smallest `p` that the test can give [-]; 0 for known noise."""
    test: str
    """"sign flips", or "known noise" where there are too few blocks for them."""


def steady_force(w: Wrenches, cfg: LocateForcesCfg) -> SteadyForce | None:
    """Return the steady force of a phase in the world, in the body or along the slip; None where contacts hide it.

    The significance is that of the largest of the shares explained in the three frames.
    """
    weight = 1 / w.std
    y = (w.force * weight[:, None]).ravel()
    sight = w.free[:, :3, :3]
    length = np.linalg.norm(w.sliding, axis=1, keepdims=True)
    slip = np.where(length > 0, w.sliding / np.maximum(length, 1e-9), 0)
    bases = {WORLD: sight, "body": sight @ w.rotation, SLIP: (sight @ slip[:, :, None])}
    labels, block = np.unique(w.block, return_inverse=True)
    block = np.repeat(block, 3)
    exact = len(labels) >= cfg.dependence.min_blocks
    rng = np.random.default_rng(cfg.seed)
    signs = flips(len(labels), rng, cfg.dependence) if exact else np.ones((1, len(labels)))
    total, statistics, fits = float(y @ y), [], {}
    for frame, basis in bases.items():
        x = (basis * weight[:, None, None]).reshape(len(y), -1)
        left, value, right = np.linalg.svd(x, full_matrices=False)
        # A direction that contacts hide nearly always is not extrapolated from the rest.
        kept = np.einsum("ri,nji,njk,rk->r", right, basis, basis, right) > w.min_visible**2 * len(basis)
        left, value, right = left[:, kept], value[kept], right[kept]
        if not kept.any():
            continue
        parts = np.stack([np.bincount(block, weights=c * y, minlength=len(labels)) for c in left.T], axis=1)
        statistics.append(((signs @ parts) ** 2).sum(axis=1))
        vector = right.T @ (left.T @ y / value)
        std = np.sqrt(((right.T / value) ** 2).sum(axis=1))
        fits[frame] = float(statistics[-1][0]), basis, vector, std, len(value)
    # Akaike's criterion: each further component must explain 2 more.
    if not fits:
        return None
    frame = max(fits, key=lambda f: fits[f][0] - 2 * fits[f][4])
    explained, basis, vector, std, freedom = fits[frame]
    scale = float(np.sqrt(max(1.0, (total - explained) / max(float(np.einsum("nii->", sight)) - freedom, 1.0))))
    if exact:
        highest = np.max(statistics, axis=0)
        p = float((highest >= highest[0] * (1 - 1e-12)).mean())
    else:
        p = float(min(1.0, len(fits) * min(chdtrc(f[4], f[0] / scale**2) for f in fits.values())))
    steady = np.einsum("nij,j->ni", basis, vector)
    # Scatter beyond the noise counts where it is significant: 3 standard errors of a mean square.
    excess = (
        1 - 1 / scale**2
        if scale**2 > 1 + cfg.solver.misfit_standard_errors * np.sqrt(2 / max(len(y) - freedom, 1))
        else 0.0
    )
    return SteadyForce(
        frame=frame,
        vector=np.pad(vector, (0, 3 - len(vector))),
        std=scale * np.pad(std, (0, 3 - len(std))),
        each=steady + excess * (w.force - steady),
        taken=excess,
        steady=steady,
        share=explained / total if total > 0 else 0.0,
        scale=scale,
        p=p,
        smallest_p=1 / len(signs) if exact else 0.0,
        test="sign flips" if exact else "known noise",
    )
