"""Settings of a diagnosis.

"Empirical" values were set on the scenes of the hidden-effect benchmark (docs/benchmarks/hidden_effects.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from concent_warp.checks import (
    Bounds,
    Count,
    Factor,
    OpenShare,
    Positive,
    PositiveDuration,
    PositiveShare,
    Share,
    WindowLength,
)
from concent_warp.diagnosis.experiment.cfg import SuggestExperimentCfg
from concent_warp.diagnosis.forces.cfg import LocateForcesCfg
from concent_warp.fit.effects.cfg import EffectSolverCfg


@dataclass(frozen=True)
class CheckDataCfg:
    """Thresholds of the check of a recording's channels."""

    gap_ratio: float = 10.0
    """Pause between two samples, over the median sampling interval, from which on it is a gap [-]. Empirical."""
    max_missing_share: Share = 0.2
    """Share of missing samples above which it is reported [-]. Empirical."""
    white_noise_ratio: float = 0.8
    """Mean squared step between samples over twice the variance, above which a channel looks like white noise [-]: 1
    for white noise, near 0 for motion (von Neumann, "Distribution of the ratio of the mean square successive difference
    to the variance", Ann. Math. Stat. 12, 1941)."""
    min_samples: Count = 30
    """Samples below which that ratio is not computed: its standard deviation is then about 0.2 under white noise."""
    max_scatter_ratio: float = 3.0
    """Standard deviation of a channel over its stated noise up to which it may stand still [-]: 3 sigma."""
    outside_margin: Share = 0.02
    """How far outside a joint's range readings may be, in shares of the range [-]: a zero that is a little off, and the
    softness of a stop. Empirical."""
    max_outside_share: Share = 0.01
    """Share of readings farther outside, above which it is reported [-]: single outliers are no motion. Empirical."""


@dataclass(frozen=True)
class SearchCfg:
    """Thresholds of the search for one missing effect.

    "Gain" is the share of the baseline's held-out error that a candidate removes [-]; "noise ratio" is the RMS residual
    over the noise standard deviation [-].
    """

    far_ratio: Positive = 20.0
    """Noise ratio of the model as given beyond which the search begins with shorter windows [-]: over long ones, a
    motion so far off is no longer in proportion to an effect's size, and fits end in local minima. Where an answer
    leaves as much, and `far_min_gain` of the first discrepancy, no other beginnings of the search are tried.
    Empirical."""
    contact_ratio: Positive = 3.0
    """What the model as given leaves, in units of the standard deviation of fits [-], where it is off by more than
    `far_ratio` x noise and a body moves freely that can be touched: the noise is raised for the fits until no more is
    left. Errors of contact models are rough: in units of a noise far below them, windows would be too short to show
    friction, and finite differences would measure jumps. Empirical."""
    coarse_windows: tuple[PositiveDuration, ...] = (2.0, 0.5)
    """Lengths of these windows [s], the first that reduces the noise ratio below `far_ratio`, else the last.
    Empirical."""
    impact_error: Share = 0.02
    """Error of velocities after an impact, over their change [-], that a second search allows for where the first does
    not explain the data, or errors of impacts may stand behind what it found, see `concent_warp.fit.effects.impacts`; 0
    for none. Empirical."""
    max_state_offset: float = 1.0
    """Largest fitted error of an initial state, in units of its standard deviation, up to which sensitivities are taken
    at the fitted states alone and not at the measured ones too: 1 sigma."""
    min_expected_gain: float = 0.5
    """Expected gain over the needed one, above which a screened candidate is fitted [-]: linear extrapolation is
    taken to be right to a factor of 2."""
    min_scanned_gain: float = 0.25
    """The same where a scanned value gains something: the best one may lie between two, and what has a threshold is far
    from linear. Empirical."""
    first_scanned_share: Share = 0.5
    """Share of the squared residual in the windows in which scanned values are tried first [-]."""
    max_scanned_rise: Annotated[float, Bounds(1)] = 1.5
    """Squared residual that a scanned value leaves there, over the least of those before, above which none beyond it is
    tried [-]. Empirical."""
    limit_halvings: Count = 4
    """Times that the distance between the best scanned value of a limit and its neighbours is halved [-]: scanned ones
    are a fifth apart, limits then 1 %, the tolerance of a nominal value."""
    remainder_promise: Share = 0.75
    """Share of the gain that `DiagnoseCfg.max_remainder` asks for which a screened candidate must promise to be fitted
    [-]: little is left there, and residuals are nearly in proportion to an effect's size."""
    fits_of_each: Count = 3
    """Most candidates that are fitted of one effect on the same elements, such as parts of one body [-]: those of one
    effect must not take the places of all others. Empirical."""
    batch_size: Count = 3
    """Candidates fitted before the search decides whether others are worth a fit. The truth is among the first three in
    most scenes. Empirical."""
    far_min_gain: Share = 0.2
    """Share of the held-out error that a shorter time step, or nominal values within their tolerance, must remove while
    more than `DiagnoseCfg.form_error_ratio` is left [-]; where they remove less, an effect is looked for first, and
    they are tried again beside it. Empirical."""
    stop_margin: Share = 0.1
    """Largest distance of a joint from a limit, over its range, from which on effects at limits are candidates [-]."""
    alone_share: float = 1 / 3
    """Share of what the best of the others leaves beyond the noise, below which an effect counts that counts only where
    it explains the data alone (`Effect.is_alone`) [-]. Empirical."""
    explained_ratio: float = 1.1
    """Noise ratio below which a fitted candidate leaves little to others [-]. Empirical."""
    noise_level_ratio: float = 1.03
    """Noise ratio below which a fit has reached the noise [-]: about one standard error of it over 1000 samples."""
    decided_share: Share = 0.5
    """Share of the first discrepancy that a fitted candidate leaves below which it leaves little to others, too [-]: no
    candidate can take away more than there is, and what a weak one takes away besides shows in the next addition."""
    explained_min_gain: float = 0.3
    """Expected gain over the best one below which a candidate is skipped after `explained_ratio` or `decided_share` is
    reached [-]. Empirical."""
    noise_level_min_gain: float = 0.5
    """The same after `noise_level_ratio` is reached [-]. Empirical."""
    restart_min_gain: float = 0.5
    """Gain over the best one above which a candidate that lags behind an `explained_ratio` fit is restarted from the
    initial states of the best [-]. Empirical."""
    polish_min_gain: float = 0.7
    """Gain over the best one above which a candidate's initial states are fitted again [-]. Empirical."""
    close_min_gain: float = 0.85
    """Gain over the best one above which a candidate may equal the best [-]. Empirical."""
    max_rounds: int = 3
    """Rounds in which the best candidate and those close to it are refitted. Empirical."""
    min_cost_fall: float = 0.01
    """Relative fall of a cost above which another round, or another refit, follows [-]. Empirical."""
    shooting_window: PositiveDuration = 0.4
    """Length of the windows of the multiple-shooting initialisation [s]. Empirical: impacts need 0.1-0.3 s, free motion
    allows more."""
    shooting_min_gain: float = 0.5
    """Gain over the best one above which a candidate is initialised by multiple shooting, or continued as windows grow,
    if no candidate explains the data [-]. Empirical."""
    shooting_fits: int = 3
    """Most candidates initialised that way. Empirical."""
    window_growth: Annotated[float, Bounds(1, above_low=True)] = 1.5
    """Factor by which windows that cannot be cut grow from one fit to the next, from `shooting_window` on [-]: one more
    impact at a time. Empirical."""
    doubtful_gain: float = 0.4
    """Best gain below which the baseline is refitted from its rivals' initial states, so that the gain is not owed to
    those alone [-]. Empirical."""
    rivals: int = 3
    """Rivals whose initial states are tried on the baseline. Empirical."""
    polished_first: Count = 1
    """Most fits whose initial states are fitted again before the others start from those of the best. Empirical."""
    promoted_share: Share = 0.7
    """Gain that a candidate promises beside nominal values within their tolerance, over the best one's, from which it
    is fitted for that [-]. Empirical."""
    stuck_share: Share = 0.5
    """Share of what a candidate promised below which its fit counts as stuck in a local minimum [-]: linear
    extrapolation is taken to be right to a factor of 2."""
    scan_step: PositiveShare = 0.25
    """Step from a scanned value from which no step of a fit lowered the cost, over its distance from the null value
    [-]. Empirical."""
    max_scan_steps: Count = 3
    """Most such steps in one direction, as long as the cost falls. Empirical."""
    polished_stuck: Count = 3
    """Most stuck fits whose initial states are fitted again then. Empirical."""
    reconsidered: Count = 5
    """Most candidates that are tried again in the place of an earlier addition once others are in the model.
    Empirical."""
    alternatives: Annotated[int, Bounds(0, 1000)] = 1
    """Most rivals of the first effect from which the search is continued, too, where an answer reaches the noise [-]; 0
    for none at all. Empirical."""
    alternatives_beyond_noise: Annotated[int, Bounds(0, 1000)] = 3
    """The same while all answers leave more than noise [-]. Empirical."""
    parallel_rivals: Share = 0.95
    """Cosine between what two rivals take from the residuals, from which on the search is continued from the stronger
    alone [-]: less than a tenth of what either takes, in squares, is then its own."""
    dependent_share: Share = 0.1
    """Variance that the data leave of a combination of an effect's parameters, over that of the same combination if
    they were independent, below which the combination's own interval may exclude its null value [-]: of two parameters
    it is one less their correlation. As the friction of two fingers that are coupled, they stand in for one another."""
    min_fold_share: Share = 0.8
    """Share of the folds' gains and losses that an accepted effect must gain [-]: 4 of 5. A fold whose motions hardly
    show the effect loses or gains little."""
    equal_error: float = 0.02
    """Relative difference of held-out errors below which candidates count as equal [-]. Empirical."""
    equal_standard_errors: float = 2.0
    """Standard errors of that difference below which candidates count as equal: 95 % of a normal distribution."""
    max_odds: Annotated[float, Bounds(1, above_low=True)] = 20.0
    """Posterior odds against a candidate, beside the most plausible one that explains as much, from which on it is not
    named [-]: 5 %, as of an interval."""
    near_equal_factor: Annotated[float, Bounds(1)] = 1.25
    """Factor on both bounds within which candidates are compared by profile likelihood before they are separated [-].
    Empirical."""
    profiled: int = 3
    """Most candidates compared that way. Empirical."""


@dataclass(frozen=True)
class ProfileLikelihoodCfg:
    """Settings of the profile likelihood of an accepted effect's parameters.

    Costs are half sums of squares in units of the noise; distances are in standard deviations of the linear fit.
    """

    first_step: Positive = 2.0
    """Distance of the first points on each side [standard deviations]: the ends of a 95 % interval."""
    step_growth: Annotated[float, Bounds(1, above_low=True)] = 3.0
    """Factor from one distance to the next [-]. Empirical."""
    max_extensions: int = 3
    """Most further distances; the last is then 54 standard deviations away. Empirical."""
    state_iterations: int = 4
    """Iterations of the initial states at each point. Empirical."""
    min_cost_fall: float = 1.0
    """Fall of the cost at a point that restarts the fit from there [cost]: log likelihood ratio 1, of residuals as
    correlated as these are. It must also exceed the roughness of the cost."""
    max_restarts: int = 3
    """Most restarts. Empirical."""
    max_step_doublings: int = 4
    """Most doublings of the distance before a restart, as long as the cost falls. Empirical."""
    min_rise_over_roughness: float = 4.0
    """Rise of the cost over its roughness, from which on a parabola can be fitted through it [-]. Empirical."""
    min_rise: float = 1.0
    """Rise of the cost that this takes at least [cost]: log likelihood ratio 1."""
    max_widening: Annotated[float, Bounds(1)] = 100.0
    """Largest factor on the linear standard deviation, also where the cost rises nowhere [-]."""
    roughness_variance: float = 0.5
    """Variance added for roughness, over the squared distance at which the parabola rises by as much [-]. Empirical."""


@dataclass(frozen=True)
class UnknownForceCfg:
    """Settings of the test for a force of no known form: radial basis functions over positions or velocities."""

    basis_functions: Count = 8
    """Over the range of a joint's position or velocity. Empirical."""
    basis_functions_many: Count = 5
    """The same for more than `few_joints` joints, and over the range of a body's speed. Empirical."""
    few_joints: int = 3
    """Joints up to which `basis_functions` apply. Empirical."""
    basis_points: Count = 12
    """Most centres over the positions that a free body visits. Empirical."""
    min_gain: float = 0.03
    """Share of the held-out error that the force must remove [-]; it stays near 0.01 on data without one. Empirical."""
    min_share: float = 0.08
    """Share of the discrepancy of the first model that the force must explain [-]; what explains less is an error of
    the form of the effects that were added: outside a simulator formulas are right to about a quarter, a twelfth in
    squares. Empirical."""
    expected_shares: tuple[PositiveShare, ...] = (0.02, 0.1, 0.5)
    """Shares of the error that the prior of the force expects, tried in turn [-]. Empirical."""
    force_scale: Positive = 0.1
    """Typical force on a free body over its weight [-]. Empirical."""
    fade_speed: Positive = 2e-3
    """Speed [m/s], or rate [rad/s] over ten, below which a force against the motion fades out: far below the speeds of
    motions that are measured."""
    lever: Positive = 0.05
    """Lever of the typical torque on a free body [m]: half the size of a hand-held object."""
    percentile: Annotated[float, Bounds(0, 50, below_high=True)] = 0.5
    """Percentile of the visited positions or velocities left out at each end [%]: excursions of single samples."""


@dataclass(frozen=True)
class TimeStepCfg:
    """Settings of the test for errors of the model's own time step."""

    max_error: Positive = 0.3
    """Error of the time step over the noise that is left after a division of the step [-]: in squares, a tenth of what
    the noise itself leaves."""
    max_division: Annotated[int, Bounds(1, 1000)] = 8
    """Most parts that a step is divided into; 1 leaves the model's time step as it is."""
    max_state_offset: Positive = 2.0
    """Fitted error of an initial state, in units of its standard deviation, beyond which it is fitted again by
    simulations with the shorter step, where more than noise is left: 95 % of a normal distribution."""
    max_renewals: Count = 5
    """Most times that what a shorter step changes is computed again about the fit to it, until it changes by less than
    `max_error`."""
    max_change_left: Share = 0.7
    """Share of the change before, above which such a change does not count as shrinking [-]. Empirical."""
    max_misfit_left: Share = 0.7
    """Share of what the model's own step leaves at measured states, above which a shorter one leaves too much there for
    the step to be why fitted states are far from them [-]. Empirical."""
    max_error_left: Positive = 1.0
    """Error over the noise that a shorter step may still have, above which nothing is said to be missing that may be
    this error [-]: the noise itself."""
    error_factor: Factor = 1.5
    """By how much that error may be larger than a first-order one [-]: motion that amplifies small differences does.
    Empirical."""
    max_error_known: Positive = 30.0
    """Error over the noise that a shorter step may still have, above which it may be of any size [-]: first order holds
    no more. Empirical."""
    max_lengthening: Annotated[int, Bounds(1, 1000)] = 8
    """Most of the model's steps that simulations take at once while effects are looked for; 1 for none."""
    max_error_of_longer: Positive = 0.5
    """Change by such a longer step over the noise [-], beyond what initial states and the model's own parameters take
    up. Predictions are corrected for it; what remains is how it differs from one candidate to another."""
    max_error_of_longer_in_contact: Positive = 0.2
    """The same where bodies touch [-]: candidates differ in when contacts begin between two steps."""
    max_share_of_contact: Positive = 0.2
    """Longest such step over the shortest time constant of the model's contacts [-]: MuJoCo's contacts are no stiffer
    than two steps, and candidates may be up to twice and a half as stiff as the model."""
    steps_of_impact: Count = 30
    """Steps that the shortest impact of a body in flight takes with a step that resolves it, if `max_division` allows:
    the phase of its beginning then matters by a few per cent."""
    decisive_gain: Share = 0.9
    """Share of the error that a shorter step must remove to be used before effects are looked for [-]: an effect that
    removes more still is more likely to stand in for the step and a part of what else is missing. Empirical."""


@dataclass(frozen=True)
class NominalCfg:
    """Settings of the fit of nominal values within their tolerance, see `concent_warp.effects.library.nominal`."""

    enabled: bool = True
    """Whether masses, lengths, gains and latencies may differ from their nominal values within the tolerance."""
    min_change: Positive = 0.1
    """Change of the predictions within the tolerance from which on a value is fitted: RMS over the noise, initial
    states fitted [-]. In squares, 1 % of what the noise itself leaves."""
    max_values: Count = 24
    """Most values that are fitted, the most visible ones. Empirical."""
    promised_share: Share = 0.5
    """Share of the least gain that a linear step must promise, or the values are not fitted [-]: within the tolerance
    residuals are in proportion to the values, right to a factor of 2."""
    decisive_gain: Share = 0.5
    """Share of the held-out error that they must remove to be tried before effects where a model is far off [-]: errors
    of all of them together may be large beside the noise of good instruments."""
    min_independent: Share = 0.05
    """Share of the change by a value that the others must not be able to produce, for it to be fitted beside them [-]:
    sensitivities are no more exact than that, and all of mass, stiffness, damping and force may scale together."""
    left_out_share: Share = 0.02
    """Share of the blocks, one at least, that are not counted where they become worst by values from other blocks [-]:
    one event that something else is behind, such as an impact, has the largest residuals of all."""
    bounded_ratio: Positive = 1.1
    """Noise ratio up to which a fit with values at their bounds counts [-]; where more is left, something larger than a
    tolerance is missing. That of `SearchCfg.explained_ratio`."""
    max_bounded_share: Share = 0.5
    """Share of the fitted values that may be at their bounds where an error in the formula of an effect is left [-]:
    more at once are less plausible than something that is missing. Empirical."""
    bounded_remainder: Share = 0.025
    """Share of the discrepancy of the model as given below which such values may leave more, up to
    `DiagnoseCfg.adequate_ratio`, where no effect has been added [-]: formulas of friction and drives are right to about
    10 %, which leaves 1 to 2 % of the squared discrepancy. Empirical."""


@dataclass(frozen=True)
class FailureCfg:
    """Settings of the list of spans and forces in which the model as given fails."""

    max_spans: int = 5
    """Most spans of time that are listed."""
    max_forces: int = 3
    """Most unexplained forces that are listed."""
    max_seconds: float = 60.0
    """Longest search for unexplained forces [s]; the forces are left out where it takes longer. No share of the time
    that the diagnosis takes: one that is resumed takes less, and gives the same result."""
    forces: LocateForcesCfg = field(default_factory=LocateForcesCfg)
    """Settings of the search for unexplained forces."""


@dataclass(frozen=True)
class DiagnoseCfg:
    """Settings of a diagnosis.

    Example:
        >>> import concent_warp as cw
        >>> cw.DiagnoseCfg(effects=("joint_friction", "joint_damping"), max_additions=1).max_additions
        1
    """

    significance_level: OpenShare = 0.05
    """Probability of naming an effect where nothing is missing [-]."""
    quiet_significance_level: OpenShare = 0.005
    """The same where the model leaves little more than noise in size, `SearchCfg.explained_ratio` [-]: such data are
    the most frequent, and errors of nominal values and formulas have a structure, too."""
    min_gain: float = 0.05
    """Share of the held-out error that an effect must remove [-]; less is significant in long recordings, and means
    little."""
    quiet_min_gain: Share = 0.125
    """The same where the model leaves little more than noise in size [-]: errors of formulas, too, can be found there,
    in long recordings. Empirical."""
    small_min_gain: Share = 0.0625
    """The same of the first effect on the model as given, if it removes `min_gain` also beside all nominal values
    within their tolerance [-]: a half of that, as errors of nominal values are not behind it. Where errors of impacts
    count as noise, `min_gain` alone."""
    min_impact_evidence: Positive = 10.0
    """Log likelihood that an effect must gain there beside errors of impacts [-], or `quiet_min_gain`: odds of 20 000,
    which leave 100 to 1 after a choice among 50 effects and Schwarz's price of two parameters."""
    min_remainder_gain: Share = 0.5
    """Share of what a model leaves beyond the noise that an effect must remove where the model leaves little,
    `adequate_ratio` [-]: one that is missing explains most of it, one that takes up an error in a formula a part.
    Empirical."""
    min_explained: Share = 0.2
    """Share of the discrepancy that the accepted effects must explain if something else is missing, or the model stays
    as given [-], over windows and in a replay in one piece: what explains less is rather an imitation. That of
    `SearchCfg.far_min_gain`."""
    max_fits: Count = 8
    """Most screened candidates that are fitted. Empirical: the truth is among the first eight in nearly all scenes."""
    max_additions: Annotated[int, Bounds(1, 1000)] = 3
    """Most effects that are added."""
    adequate_ratio: float = 1.25
    """RMS residual over noise up to which a model explains the data [-]. Empirical."""
    adequate_channel_ratio: Positive = 1.5
    """The same of each channel alone [-]: many good channels do not outweigh one that the model misses. Empirical."""
    form_error_ratio: Positive = 2.0
    """RMS residual over noise up to which a remainder may be an error in the formulas of accepted effects [-], if it is
    less than `UnknownForceCfg.min_share` of the first discrepancy. Empirical."""
    max_form_error: Share = 0.25
    """Share of the first discrepancy up to which such a remainder may be one that is more, if a flexible correction of
    the effects takes it away [-]: formulas are right to a half, a quarter in squares."""
    small_form_error: Share = 0.01
    """Share of the first discrepancy below which a remainder of up to `small_form_error_ratio` may be one, too [-]:
    formulas are right to a tenth, a hundredth in squares, and data may be more precise than that."""
    small_form_error_ratio: Positive = 5.0
    """RMS residual over noise up to which it may [-]; beyond it too much is left to say what is missing. Empirical."""
    max_remainder: Share = 0.15
    """Share of such a remainder that a further effect may leave, if it is to be named all the same [-]: one that is
    missing explains nearly all of it, one that takes up an error in a formula a part. Of several effects that
    leave more than noise each may leave no more of what is left without it, or they do not explain the data. Empirical.
    """
    max_typical_sizes: Positive = 30.0
    """Size of a parameter over its typical size, from which on an effect is not accepted where what it explains is less
    than `max_form_error` of the first discrepancy [-]: 2 % of the Cauchy prior of sizes lie beyond. Of so small a
    remainder an error in the formulas of the effects before it is the more plausible cause."""
    null_samples: Annotated[int, Bounds(1, 1_000_000)] = 400
    """Sign-flipped data sets from which the null distribution of the best candidate's gain is taken; the smallest
    p-value is 1 / (null_samples + 1)."""
    effects: tuple[str, ...] = ()
    """Names of the effects to consider; all where empty."""
    window: WindowLength | None = None
    """Length of a window [s]; by default as long as the motion allows."""
    jobs: Annotated[int, Bounds(-1, 4096, excluded=0)] = -1
    """Processes at a time; -1: one per CPU. `joblib.parallel_config` selects another backend."""
    seconds: PositiveDuration | None = None
    """Wall time after which the answer is given with what is known by then and what is unsettled [s]; None: as long as
    it takes. The model as given is always fitted."""
    seed: int = 0
    """Seed of all random numbers."""
    explain: bool = True
    """Whether to list where the model fails and to suggest an experiment, which takes additional time."""
    gradient: bool = False
    """Whether fits of friction, mass and contact stiffness may start from values found by gradients through Newton."""
    data: CheckDataCfg = field(default_factory=CheckDataCfg)
    """Check of the recording."""
    fits: EffectSolverCfg = field(default_factory=EffectSolverCfg)
    """Windows, simulations and least squares."""
    search: SearchCfg = field(default_factory=SearchCfg)
    """Search for one missing effect."""
    profile: ProfileLikelihoodCfg = field(default_factory=ProfileLikelihoodCfg)
    """Profile likelihood of accepted parameters."""
    unknown_force: UnknownForceCfg = field(default_factory=UnknownForceCfg)
    """Test for a force of no known form."""
    time_step: TimeStepCfg = field(default_factory=TimeStepCfg)
    """Test for errors of the model's own time step."""
    nominal: NominalCfg = field(default_factory=NominalCfg)
    """Nominal values within their tolerance."""
    doubtful_replay: Factor = 10.0
    """Residual over noise of the better model, replayed in one piece, above which the answer says so [-]. Windows
    forgive what a replay does not; errors of formulas grow along it, so that right answers have several times the
    noise."""
    failures: FailureCfg = field(default_factory=FailureCfg)
    """Where the model as given fails."""
    experiment: SuggestExperimentCfg = field(default_factory=SuggestExperimentCfg)
    """The suggested experiment."""
