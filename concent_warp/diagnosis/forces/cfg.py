"""Settings of the search for unexplained forces.

"Empirical" values were set on the scenes of the tests and of the hidden-effect benchmark (docs/benchmarks).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from concent_warp.checks import MAX_COUNT, Bounds, Count, OpenShare, Positive, PositiveDuration, Share, WindowLength


@dataclass(frozen=True)
class WindowSolverCfg:
    """Settings of the least squares in one window."""

    min_readings: Annotated[int, Bounds(3, MAX_COUNT)] = 5
    """Readings of a signal in a window below which its acceleration is not estimated: 3 unknowns and 2 to spare."""
    substeps: Count = 40
    """Parts of a window at which the linear response is tabulated; between them it is interpolated."""
    min_sliding_speed: Positive = 0.02
    """Speed below which sliding friction damps no more than at this speed [m/s]. Empirical."""
    misfit_standard_errors: float = 3.0
    """Standard errors of a mean square above 1 from which on a window's variances grow with its misfit: 3 sigma."""


@dataclass(frozen=True)
class ContactStateCfg:
    """Thresholds of the contact phase of a free body in one window."""

    lasting_share: Share = 0.8
    """Share of a window above which a contact lasts through it [-]. Empirical."""
    max_interruption: float = 0.02
    """Longest interruption of a contact that is put down to errors of the smoothed pose [s]. Empirical."""
    rolling_ratio: float = 0.25
    """Speed at the contact over the speed of the body, below which it rolls or is carried [-]. Empirical."""
    min_constraint: float = 0.05
    """Mean squared normal component of a unit motion, above which lasting contacts constrain it [-]. Empirical."""
    motion_standard_errors: float = 3.0
    """Standard errors of the speed above which a body moves: 3 sigma."""
    direction_standard_errors: float = 2.0
    """Standard errors of the speed at which a direction of sliding counts by 0.7: 2 sigma."""


@dataclass(frozen=True)
class FeatureCfg:
    """Settings of the features that forces are tested against."""

    slow_percentile: Annotated[float, Bounds(0, 100)] = 25.0
    """Percentile of a joint's speed below which motion is slow [%]. Empirical."""
    peak_share: Share = 0.75
    """Share of the largest drive force above which it is near its peak [-]. Empirical."""
    rate_step: PositiveDuration = 0.01
    """Time over which the rate of a command is taken [s]. Empirical."""
    direction_standard_errors: Positive = 2.0
    """Standard errors of the speed at which a direction of motion counts by 0.7: 2 sigma."""


@dataclass(frozen=True)
class DependenceCfg:
    """Settings of the sign-flip tests of dependence on features."""

    level: OpenShare = 0.05
    """Significance level [-]."""
    flips: Count = 999
    """Random sign flips; the smallest p-value is 1 / (flips + 1)."""
    exact_blocks: Annotated[int, Bounds(0, 24)] = 11
    """Blocks up to which all 2^(blocks - 1) flips are enumerated: as many as random ones at 11."""
    min_windows_per_block: Count = 2
    """Shortest block [windows]; windows overlap by half, so that shorter blocks are correlated."""
    max_windows_per_block: Count = 4
    """Longest block [windows]. Empirical."""
    wanted_blocks: Count = 24
    """Blocks aimed at within these lengths. Empirical."""
    min_blocks: Count = 5
    """Blocks below which nothing is tested: the smallest p-value of fewer is 1/8 or more."""
    max_patterns: int = 2
    """Most features that explain one force together."""
    min_share: Share = 0.1
    """Share of a force's weighted square that a feature must explain [-]: less may be left by the linearisation of
    windows. Empirical."""
    min_share_in_contact: Share = 0.25
    """The same in contact, where gaps smaller than the noise decide over contact [-]. Empirical."""
    equal_standard_errors: float = 2.0
    """Standard errors of a difference of shares below which features cannot be distinguished: 95 % of a normal
    distribution."""


@dataclass(frozen=True)
class ForcePlaceCfg:
    """Settings of the estimate of the point on which a force acts."""

    surface_points: Count = 6000
    """Points sampled on a body's surface."""
    max_axis_error: float = 0.35
    """Standard error of the point along an axis, over the body's radius, above which the axis is open [-].
    Empirical."""
    min_inward: Annotated[float, Bounds(-1, 1)] = 0.25
    """Cosine between force and inward normal above which a force pushes on the surface [-]. Empirical."""
    parallel_cosine: Annotated[float, Bounds(-1, 1)] = 0.9
    """Cosine above which two directions are parallel [-]: 26 degrees."""
    max_coordinate_error: float = 0.4
    """Standard error of a coordinate, over the body's half extent, above which it is reported as unknown [-].
    Empirical."""
    edge_share: Share = 0.75
    """Coordinate on a face, over the half extent, above which it is near the edge [-]."""
    shape_tolerance: float = 2e-3
    """Distance from the surface or from a contact that is put down to errors of the model's shape [m]. Empirical."""
    min_visible: Share = 0.3
    """Share of a direction's length that contacts must leave visible [-]. Empirical."""


@dataclass(frozen=True)
class LocateForcesCfg:
    """Settings of the search for unexplained forces.

    Example:
        >>> import concent_warp as cw
        >>> cw.LocateForcesCfg(0.1).length
        0.1
    """

    length: WindowLength | None = None
    """Length of a window [s]; by default 0.1 s for joints alone, 0.12 s with free bodies, whose readings are coarser,
    and up to 0.3 s where readings are rare. Errors of forces fall with its square; changes within it are averaged, and
    a body that starts or stops within it is left out."""
    extra_starts: int = 4
    """Further initial states of each window, sampled from the error of the smoothed one."""
    seed: int = 0
    """Seed of all random numbers."""
    min_phase_windows: int = 3
    """Windows below which a phase is left out."""
    max_contact_share: Share = 0.05
    """Share of the time up to which a joint's contacts are neglected [-]. Empirical."""
    significant_ratio: float = 1.7
    """RMS force over noise above which a force is significant whatever it depends on [-]. Empirical: up to 1.4 occurs
    without any force where contacts change within windows."""
    detectable_standard_errors: float = 3.0
    """Standard errors above which a steady force is detected: 3 sigma."""
    solver: WindowSolverCfg = field(default_factory=WindowSolverCfg)
    """Least squares in one window."""
    contact: ContactStateCfg = field(default_factory=ContactStateCfg)
    """Contact phases."""
    features: FeatureCfg = field(default_factory=FeatureCfg)
    """Features that forces are tested against."""
    dependence: DependenceCfg = field(default_factory=DependenceCfg)
    """Tests of dependence on these."""
    place: ForcePlaceCfg = field(default_factory=ForcePlaceCfg)
    """Where forces act."""
