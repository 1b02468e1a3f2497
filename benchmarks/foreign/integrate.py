"""Accurate integration of equations of motion written by hand, and forms of friction that such machines have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import njit

Derivative = Callable[[float, np.ndarray, np.ndarray, Any, np.ndarray], None]
"""Writes the derivative of a state, by time [s], state, what acts on each drive, and the values of the machine."""

CREEP = 1e-3
"""Speed at which regularised dry friction is about three quarters of its level [rad/s or m/s]."""


class Held(NamedTuple):
    """A command that is held until the next one."""

    time: np.ndarray
    """Times [s], shape (commands,)."""
    value: np.ndarray
    """Values, shape (commands,)."""


@njit(cache=True)
def coulomb(speed: float, level: float) -> float:
    """Return dry friction, which turns its sign over about 1 mrad/s or 1 mm/s."""
    return level * np.tanh(speed / CREEP)


@njit(cache=True)
def stribeck(speed: float, level: float, extra: float, fades: float) -> float:
    """Return dry friction that is larger out of rest, by an extra that fades with the speed."""
    return (level + extra * np.exp(-((speed / fades) ** 2))) * np.tanh(speed / CREEP)


@njit(cache=True)
def lugre(bristle: float, speed: float, level: float, stiffness: float, damping: float) -> tuple[float, float]:
    """Return friction by bristles and the rate of their deflection: Canudas de Wit et al., IEEE TAC 40(3), 1995."""
    rate = speed - stiffness * abs(speed) / max(level, 1e-9) * bristle
    fading = np.exp(-((speed / 0.02) ** 2))
    return stiffness * bristle + damping * fading * rate, rate


@njit
def _step(rhs, values, t, y, h, u_of, lag, k, out):
    """Write the state after a step of Dormand and Prince into `out`; return the error in units of the tolerance."""
    start, target, since = u_of
    n = y.size
    c = (0.0, 0.2, 0.3, 0.8, 8.0 / 9.0, 1.0, 1.0)
    a = (
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.2, 0.0, 0.0, 0.0, 0.0, 0.0),
        (3.0 / 40, 9.0 / 40, 0.0, 0.0, 0.0, 0.0),
        (44.0 / 45, -56.0 / 15, 32.0 / 9, 0.0, 0.0, 0.0),
        (19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729, 0.0, 0.0),
        (9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656, 0.0),
        (35.0 / 384, 0.0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84),
    )
    e = (71.0 / 57600, 0.0, -71.0 / 16695, 71.0 / 1920, -17253.0 / 339200, 22.0 / 525, -1.0 / 40)
    u = np.empty_like(target)
    stage = np.empty(n)
    for s in range(7):
        for i in range(n):
            total = y[i]
            for j in range(s):
                total += h * a[s][j] * k[j, i]
            stage[i] = total
        for i in range(u.size):
            u[i] = target[i]
            if lag[i] > 0.0:
                u[i] += (start[i] - target[i]) * np.exp(-(t + c[s] * h - since) / lag[i])
        rhs(t + c[s] * h, stage, u, values, k[s])
    error = 0.0
    for i in range(n):
        out[i] = stage[i]
        local = 0.0
        for s in range(7):
            local += h * e[s] * k[s, i]
        error += (local / (1e-10 + 1e-7 * max(abs(y[i]), abs(out[i])))) ** 2
    return np.sqrt(error / n)


@njit
def _integrate(rhs, values, y, stops, targets, lag):
    """Return the states at all stops; `targets[k]` acts from stop k on."""
    states = np.empty((stops.size, y.size))
    states[0] = y
    k = np.empty((7, y.size))
    following = np.empty_like(y)
    start = targets[0].copy()
    h = 1e-5
    for stop in range(stops.size - 1):
        t, end = stops[stop], stops[stop + 1]
        since = t
        target = targets[stop]
        while t < end:
            step = min(h, end - t)
            error = _step(rhs, values, t, y, step, (start, target, since), lag, k, following)
            if error <= 1.0:
                t = end if step == end - t else t + step
                y[:] = following
                if step == h or error > 0.1:
                    h = step * min(5.0, 0.9 * max(error, 1e-8) ** -0.2)
            elif error > 1.0:
                h = step * max(0.1, 0.9 * error**-0.2)
            else:
                raise ValueError("the equations of motion gave no number")
            if h < 1e-12:
                raise ValueError("the step became too small")
        for i in range(start.size):
            start[i] = target[i] + (start[i] - target[i]) * (np.exp(-(end - since) / lag[i]) if lag[i] > 0.0 else 0.0)
        states[stop + 1] = y
    return states


def integrate(
    derivative: Derivative,
    values: NamedTuple,
    initial: np.ndarray,
    commands: Sequence[Held],
    lags: Sequence[float],
    times: np.ndarray,
    settle: float,
) -> np.ndarray:
    """Integrate by Dormand and Prince's method of order 5, to 1e-7 a step, without a step across a change of command.

    Args:
        derivative: Equations of motion, compiled by numba.
        values: True values of the machine.
        initial: State `settle` before time 0, shape (states,).
        commands: Command of each drive; before its first one the drive has that one.
        lags: Time constant of each drive's lag [s]; 0 for none.
        times: Where the state is wanted [s], increasing.
        settle: How long the machine has had the first commands at time 0 [s].

    Returns:
        States, shape (times, states).
    """
    changes = [c.time for c in commands]
    stops = np.unique(np.concatenate([[-settle, 0.0], times, *changes]))
    stops = stops[(stops >= -settle) & (stops <= max(times[-1], 0.0))]
    targets = np.zeros((stops.size, len(commands)))
    for i, command in enumerate(commands):
        at = np.searchsorted(command.time, stops, side="right") - 1
        targets[:, i] = command.value[np.maximum(at, 0)]
    states = _integrate(derivative, values, initial.astype(float), stops, targets, np.asarray(lags, float))
    return states[np.searchsorted(stops, times)]
