"""Settings of a suggested motion: limits, search, and when effects count as separated."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from concent_warp.checks import MAX_NUMBER, Bounds, Count, Duration, Positive, PositiveDuration, Share
from concent_warp.diagnosis.experiment.cfg import MotionMenuCfg
from concent_warp.fit.effects.fit import FitEffectsCfg

Method = Literal["best", "menu", "optimised", "random"]
"""Where a motion is looked for: the menu, the parametrised trajectories, both, or one of the latter at random."""


@dataclass(frozen=True)
class MotionLimitsCfg:
    """Limits of a suggested motion, relative to the present recording unless they are absolute.

    Example:
        >>> import concent_warp as cw
        >>> cw.MotionLimitsCfg(speed=0.5, workspace=(-0.3, -0.3, 0.0, 0.3, 0.3, 0.5)).speed
        0.5
    """

    reach: Positive = 1.0
    """Range of the commands and of the joint positions over the recorded one, about its middle [-]. Limits of joints
    and actuators in the model hold besides."""
    speed: Positive = 1.0
    """Highest speed of a joint over the highest one in the recording [-]."""
    force: Share = 0.9
    """Highest force of an actuator over its limit in the model [-]."""
    unlimited_force: Positive = 1.2
    """The same over the highest force in the recording, for actuators without a limit [-]."""
    workspace_margin: Duration = 0.05
    """How far moving links may leave the box that they fill in the recording [m]."""
    workspace: Annotated[tuple[float, ...], Bounds(-MAX_NUMBER)] = ()
    """Box that moving links and objects must not leave, x, y and z of its lowest corner, then of its highest [m]; by
    default as `workspace_margin` says, for links alone."""
    contacts: bool = False
    """Whether bodies may touch that do not touch in the recording."""
    tolerance: Share = 0.02
    """Share by which a simulation may exceed limits of speed and reach [-]: readings are sampled."""


@dataclass(frozen=True)
class TrajectoryCfg:
    """Shape of the parametrised trajectories.

    Joint setpoints are finite Fourier series (Swevers, Ganseman, Tukel, De Schutter, Van Brussel, "Optimal robot
    excitation and identification", IEEE Trans. Robotics and Automation 13(5), 1997).
    """

    harmonics: Count = 4
    """Harmonics of a Fourier series."""
    frequencies: Annotated[tuple[Positive, Positive], Bounds(above_low=True, ascending=True)] = (0.12, 1.2)
    """Lowest and highest base frequency [Hz]: from slow reversals to the bandwidth of common servos over the highest
    harmonic."""
    blend_time: PositiveDuration = 0.5
    """Time in which a series begins and ends at rest [s]."""
    offset: Share = 0.15
    """Largest change of recorded commands, as a share of their range [-]: they bring tools to objects."""
    time_scales: Annotated[tuple[Positive, Positive], Bounds(above_low=True, ascending=True)] = (0.5, 1.5)
    """Slowest and fastest repetition of recorded commands, over the recorded speed [-]."""
    throws: Count = 3
    """Motions of an object by hand in one suggestion; each is a demonstration of its own."""
    height: Duration = 0.6
    """Highest drop above where an object rests [m], unless the recording has higher ones."""
    tilt: Annotated[float, Bounds(0.0, 3.141592653589793)] = 0.5
    """Largest tilt of an object that is dropped [rad]."""
    spin: Positive = 10.0
    """Fastest spin of an object about the vertical [rad/s]."""


@dataclass(frozen=True)
class SuggestCfg:
    """Settings of a suggested motion.

    Example:
        >>> import concent_warp as cw
        >>> cw.SuggestCfg(duration=5.0, limits=cw.MotionLimitsCfg(speed=0.5)).limits.speed
        0.5
    """

    method: Method = "best"
    """Where the motion is looked for: "menu" (sweeps, reversals, chirps, holds, repetitions, pushes and drops),
    "optimised" (trajectories whose parameters are searched), "best" of both, or "random" (one such trajectory within
    the limits, for comparison)."""
    duration: PositiveDuration = 8.0
    """Longest motion [s]."""
    evaluations: Count = 96
    """Trajectories that are simulated in the search of each kind."""
    population: Annotated[int, Bounds(4, 4096)] = 12
    """Trajectories in one batch of simulations."""
    enough: Positive = 100.0
    """Evidence over what is needed from which on no better motion is looked for [-]: of all pairs of hypotheses, as the
    search averages them."""
    sufficient: Positive = 2.0
    """Evidence over what is needed, for each pair, from which on a motion of the menu is taken without a search,
    however small the differences of the predictions are [-]: recordings of longer motions decide no more, and take
    longer to diagnose. Empirical."""
    patience: Count = 3
    """Batches without a better trajectory after which a search ends."""
    min_gain: Positive = 0.01
    """What counts as better, in the logarithm that the search maximises [-]: odds that are lower by 1 %."""
    payloads: bool = True
    """Whether a known weight may be fastened to a link or an object (`MotionMenuCfg.extra_mass`), where no motion
    without one decides everything."""
    max_hypotheses: Annotated[int, Bounds(2, 64)] = 6
    """Most hypotheses that are compared, the likeliest first; the cost grows with their number."""
    max_interval: Positive = 0.25
    """Half the 95 % interval of a parameter over its distance from the null value, above which an effect that is not in
    a group is not known well enough [-]."""
    decisive: Positive = 0.05
    """Squared error by which a refitted hypothesis must exceed the true one, over that of all data, old and new, to be
    excluded [-]: 2.5 times what a diagnosis counts as equal (`SearchCfg.near_equal`)."""
    clear_separation: Positive = 3.0
    """RMS difference of predictions over the noise, the second hypothesis refitted, from which on evidence counts in
    full [-]: below, errors of the formulas may be as large. Empirical."""
    max_nominal_values: int = 8
    """Most nominal values (masses, lengths, gains, latencies within their tolerance, `NominalCfg`) that a refit may
    shift in the search [-]; where there are more, they are open for the best motions only, as simulations grow with
    them."""
    step: Positive = 0.3
    """Step of finite differences, over the standard deviation of a parameter or of an initial state [-]."""
    window: PositiveDuration = 2.0
    """Longest window in which free bodies that can be touched are predicted from a measured state [s], as in a
    diagnosis (`ObservationCfg.max_contact_length`)."""
    seed: int = 0
    """Seed of the search."""
    limits: MotionLimitsCfg = field(default_factory=MotionLimitsCfg)
    """Limits of the motion."""
    trajectory: TrajectoryCfg = field(default_factory=TrajectoryCfg)
    """The parametrised trajectories."""
    menu: MotionMenuCfg = field(default_factory=MotionMenuCfg)
    """The menu."""
    fit: FitEffectsCfg = field(default_factory=FitEffectsCfg)
    """Fit of each hypothesis to the data at hand."""
