"""Settings of the explanation of failed trials; this module imports no heavy packages."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from concent_warp.checks import Bounds, Count, Duration, OpenShare, Positive, PositiveDuration, Share


@dataclass(frozen=True)
class ContactStartCfg:
    """Where a trial began, by measurement and contact."""

    grasp_span: PositiveDuration = 0.4
    """First part of a trial over which the pose of the object in the hand is averaged [s]; it should not slip there."""
    fixture_distance: Positive = 0.02
    """Distance of a fixed object's tracked pose from that of the scene from which on it is taken to stand where it is
    tracked [m]; below, where the scene has it."""
    penetration: float = 5e-4
    """Penetration that a firm grasp has in the model anyway [m]."""
    penetration_std: float = 2e-4
    """Penetration beyond it that counts as much as a standard deviation of the pose [m]."""
    position_std: float = 1e-3
    """Standard deviation of a mean tracked position [m]: the part of the tracker's errors that averaging leaves."""
    orientation_std: float = 0.01
    """The same of an orientation [rad]."""
    iterations: int = 4
    """Iterations of Powell's method."""
    grasp_iterations: Count = 4
    """Iterations in which an object is fitted between the fingers."""


@dataclass(frozen=True)
class WindowsCfg:
    """Short simulations from measured states, by which an error of tracked poses is judged.

    The tolerances are about the errors that windows of trials without an error of the poses have.
    """

    length: PositiveDuration = 0.2
    """Length of a window [s]: a few time constants of a servo under load."""
    spacing: PositiveDuration = 0.2
    """Least time between the beginnings of windows [s]."""
    most: Count = 6
    """Most windows of a trial."""
    smoothing: PositiveDuration = 0.1
    """Time on either side of a beginning over which readings are averaged there [s]."""
    settling: Duration = 0.04
    """Time from a beginning from which on joints are compared [s]."""
    joints: Positive = 4.0
    """Tolerance of joints in units of their noise [-]."""
    position: Positive = 1e-3
    """Tolerance of the mean position of the object in a window [m]."""
    orientation: Positive = 0.02
    """Tolerance of its mean orientation [rad]."""
    diverged: Positive = 8.0
    """Loss of a window that diverges [-]."""


@dataclass(frozen=True)
class PoseBiasCfg:
    """Settings of the search for an error of tracked poses."""

    positions: tuple[float, ...] = (3e-3, 6e-3, 1e-2, 1.5e-2)
    """Errors along each axis, to both sides, of which the best is the first guess [m]."""
    orientations: tuple[float, ...] = (0.06, 0.12, 0.2)
    """The same about each axis [rad]."""
    position: float = 2.5e-3
    """Standard deviation of the first samples about the first guess [m]."""
    orientation: float = 0.03
    """The same of orientations [rad]."""
    samples: Count = 20
    """Samples in each iteration."""
    elite: Count = 6
    """Samples of the smallest misfit, from which the next ones are taken."""
    iterations: Count = 6
    """Iterations on each half of the trials."""
    last_iterations: Count = 3
    """Iterations on all of them, from what the halves show."""
    least_units: Count = 6
    """Pieces of evidence that gains are tested on, at least: trials, or parts of them where they are fewer."""
    prior: tuple[float, float] = (0.05, 1.0)
    """Standard deviations of errors before anything is known [m], [rad], wide: the squares of errors over these are
    added to the loss, so that of errors that explain as much, as where nothing is touched, the smallest is taken."""
    floor: tuple[float, float] = (3e-4, 5e-3)
    """Smallest standard deviations of samples [m], [rad]: no smaller error is distinguished."""


@dataclass(frozen=True)
class JudgeCfg:
    """When trials differ from the model, and what explains the difference. Thresholds are empirical."""

    window: PositiveDuration = 0.25
    """Length of the windows in which measurement and prediction are compared [s]."""
    clearance: Positive = 0.003
    """Distance of the manipulated object from other bodies below which the robot does not move freely [m]."""
    least_free: PositiveDuration = 0.2
    """Time of free motion of a trial from which on it is judged [s]."""
    significance: OpenShare = 0.05
    """Probability of a discrepancy of all trials together where there is none [-]."""
    least_ratio: Positive = 1.5
    """Misfit over that of simulated trials from which on a discrepancy counts [-], besides being significant, and of a
    single trial above 95 % of these."""
    free_ratio: Positive = 2.0
    """Joint errors in free motion over the 95 % quantile of simulated trials from which on they are physical [-]."""
    explained: Share = 0.5
    """Share of the misfit above that of simulated trials that a missing effect must explain [-]."""
    least_gain: Share = 0.15
    """Share of the loss of short windows that an error of tracked poses must remove in trials that it was not fitted
    to, and of a single trial [-]."""
    least_bias: Positive = 3.0
    """Size of an error of tracked poses over the tracker's noise, along or about one axis, from which on it is a cause
    [-]: policies are trained for smaller ones."""
    weak_policy: Share = 0.7
    """Success rate in the policy's own simulation up to which the policy is the cause [-]."""
    least_failures: Share = 0.5
    """Share of the failure rate of the trials that the policy's own simulation must show, where replays agree and it
    succeeds from most starts, for the policy to be the cause [-]: it fails now and then."""
    rate_trials: Count = 24
    """Most trials, drawn from failed and successful ones, from whose starts the policy's failure rate in its own
    simulation is counted, where replays agree and it succeeds from most starts of failed trials."""
    credible_start: Positive = 2.0
    """Misfit up to which measured starts are credible [-]; noise alone leaves about 1. Where the policy fails in
    simulation from such starts, no error of the tracked poses is searched for."""
    at_limit: Share = 0.95
    """Share of a limit of commands from which on it counts as reached [-]."""


@dataclass(frozen=True)
class ExplainCfg:
    """Settings of the explanation of failed trials.

    Example:
        >>> import concent_warp as cw
        >>> cw.ExplainCfg(repetitions=8, diagnose_trials=3).repetitions
        8
    """

    repetitions: Count = 4
    """Episodes in the policy's own simulation from the start of each trial; more where the trials are so few that there
    would be less than `simulated`."""
    most_trials: Count = 12
    """Most failed trials that are explained, the first ones."""
    successes: Annotated[int, Bounds(0, 10_000)] = 4
    """Most successful trials whose free motion is judged besides: failed ones may have little of it."""
    simulated: Count = 24
    """Simulated trials that the others are compared with; of few, a single trial that differs is not significant."""
    diagnose: bool = True
    """Whether the missing physical effect is searched for, which takes minutes."""
    diagnose_trials: Count = 2
    """Failed trials that it is searched for in, where the joints do not differ in free motion."""
    free_trials: Count = 6
    """Trials that it is searched for in up to their first contact, where the joints differ in free motion, those with
    the longest: without contacts it is found in less time, and nothing else can be the reason."""
    free_pool: Count = 64
    """Further trials, failed and successful ones, among which these are looked for."""
    effects: tuple[str, ...] = ()
    """Effects to consider; by default those of joints and drives where the joints differ in free motion, else all."""
    additions: Annotated[int, Bounds(1, 10)] = 1
    """Most missing effects that are named."""
    seconds: PositiveDuration | None = 600.0
    """Time after which the search for an effect gives its best answer so far [s]; None: as long as it takes. A second
    one, for an effect that whole trials prefer, has as long again."""
    jobs: Annotated[int, Bounds(-1, 4096, excluded=0)] = -1
    """Processes at a time of that search; -1: one per CPU."""
    seed: int = 0
    """Seed of all random numbers."""
    judge: JudgeCfg = field(default_factory=JudgeCfg)
    """Judgement of the evidence."""
    start: ContactStartCfg = field(default_factory=ContactStartCfg)
    """Starts of trials that measurement and contact agree on."""
    windows: WindowsCfg = field(default_factory=WindowsCfg)
    """Short simulations by which such an error is judged."""
    bias: PoseBiasCfg = field(default_factory=PoseBiasCfg)
    """Search for a constant error of tracked poses."""
