"""A constant error of the tracked poses of the manipulated object that explains trials.

If the tracker shows the object where it is not, the model, started from the tracked pose, lets it touch other bodies at
other times and places than it did. The error is searched for by the cross-entropy method (Rubinstein and Kroese 2004):
trials are replayed from poses corrected by samples of it, and the samples move to those of the smallest misfit. In
each iteration the corrected poses are moved to where they overlap with nothing, which no error in common explains; so
an error that the grasp excludes costs as much as one that later contact excludes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from concent_warp.deploy.explain.cfg import PoseBiasCfg
from concent_warp.deploy.explain.contact_start import ContactStarts, moved
from concent_warp.deploy.explain.measured_start import MeasuredStart
from concent_warp.deploy.explain.misfit import misfit
from concent_warp.deploy.explain.replay_trial import Replayer, TrialReadings
from concent_warp.recording.recording import Demonstration


@dataclass(frozen=True)
class PoseBias:
    """An error of tracked poses, in common to the trials it was fitted to."""

    value: np.ndarray
    """Tracked less true: position [m] and rotation vector, world frame, shape (6,)."""
    std: np.ndarray
    """Standard deviation of the best samples, shape (6,)."""
    before: np.ndarray
    """Misfit of each trial without it, shape (T,)."""
    after: np.ndarray
    """Misfit of each trial with it, shape (T,)."""
    starts: tuple[MeasuredStart, ...] = field(repr=False)
    """Starts of the trials, corrected."""


@dataclass(frozen=True)
class TrialToFit:
    """A trial with its readings and its start as measured."""

    demonstration: Demonstration
    readings: TrialReadings
    start: MeasuredStart


def fit_pose_bias(
    trials: Sequence[TrialToFit],
    replayer: Replayer,
    contact: ContactStarts,
    joint_scale: float,
    cfg: PoseBiasCfg,
    *,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> PoseBias:
    """Return the error of tracked poses that explains trials best.

    Args:
        trials: The trials; all of them are replayed.
        replayer: Replays them.
        contact: Removes overlaps.
        joint_scale: See `misfit`.
        cfg: Settings.
        seed: Seed of the samples.
        progress: Called with the share done, 0..1.
    """
    rng = np.random.default_rng(seed)
    floor = np.repeat(cfg.floor, 3)
    std = np.repeat((cfg.position, cfg.orientation), 3)
    before = _misfits(trials, replayer, contact, joint_scale, np.zeros((1, 6)))[:, 0]
    guesses = _guesses(cfg)
    cost = _misfits(trials[: cfg.scanned], replayer, contact, joint_scale, guesses, each=True).mean(axis=0)
    best = mean = guesses[cost.argmin()]
    lowest = float(_misfits(trials, replayer, contact, joint_scale, best[None]).mean())
    if lowest > before.mean():
        best, lowest = np.zeros(6), float(before.mean())
    for k in range(cfg.iterations):
        samples = np.concatenate([[mean, best], mean + std * rng.normal(size=(cfg.samples, 6))])
        cost = _misfits(trials, replayer, contact, joint_scale, samples).mean(axis=0)
        order = np.argsort(cost)
        if cost[order[0]] < lowest:
            best, lowest = samples[order[0]], float(cost[order[0]])
        elite = samples[order[: cfg.elite]]
        mean, std = elite.mean(axis=0), np.maximum(elite.std(axis=0), floor)
        if progress is not None:
            progress((k + 2) / (cfg.iterations + 1))
    after = _misfits(trials, replayer, contact, joint_scale, best[None])[:, 0]
    starts = tuple(contact.settled(corrected(t.start, contact.address, best))[0] for t in trials)
    return PoseBias(best, std, before, after, starts)


def corrected(start: MeasuredStart, address: int, bias: np.ndarray) -> MeasuredStart:
    """Return a start whose manipulated object stands where it is if its tracked pose has an error (6,)."""
    qpos = start.qpos.copy()
    qpos[address : address + 7] = moved(start.qpos[address : address + 7], -bias)
    return replace(start, qpos=qpos)


def _guesses(cfg: PoseBiasCfg) -> np.ndarray:
    """Return no error, and errors along and about single axes, shape (N, 6)."""
    found = [np.zeros(6)]
    for axis in range(6):
        for size in cfg.positions if axis < 3 else cfg.orientations:
            found += [sign * size * np.eye(6)[axis] for sign in (1, -1)]
    return np.array(found)


def _misfits(
    trials: Sequence[TrialToFit],
    replayer: Replayer,
    contact: ContactStarts,
    joint_scale: float,
    bias: np.ndarray,
    *,
    each: bool = False,
) -> np.ndarray:
    """Return the misfit of each trial under each error (N, 6), shape (T, N).

    Overlaps are removed under each error, or else under the first one and in the others alike.
    """
    found = np.zeros((len(trials), len(bias)))
    for k, trial in enumerate(trials):
        pose = trial.start.qpos[contact.address : contact.address + 7]
        overlaps = [
            contact.settled(corrected(trial.start, contact.address, one))[1] for one in (bias if each else bias[:1])
        ]
        if not each:
            overlaps = overlaps * len(bias)
        poses = np.stack([moved(moved(pose, -b), o) for b, o in zip(bias, overlaps, strict=True)])
        replayed = replayer.run(trial.demonstration, trial.readings, trial.start, poses)
        found[k] = misfit(trial.readings, replayed, joint_scale, bias).total
    return found
