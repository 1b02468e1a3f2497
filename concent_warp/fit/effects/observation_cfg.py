"""Settings by which recordings are cut into windows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from concent_warp.checks import Bounds, Count, Factor, Positive, PositiveDuration, Share


@dataclass(frozen=True)
class ObservationCfg:
    """How recordings are cut into windows, and how uncertain the initial states of these are.

    "Empirical" values were set on the scenes of the hidden-effect benchmark.
    """

    velocity_time: PositiveDuration = 0.03
    """Time over which the noise of a position makes a velocity at the start of a window uncertain [s]: about the time
    over which a velocity is estimated."""
    state_noise: Positive = 3.0
    """Uncertainty of a measured state at the start of a window, in standard deviations of the measurement noise [-]:
    3 sigma."""
    unmeasured_position: Positive = 1e-3
    """Uncertainty of a position that no sensor measures [m or rad]. Empirical."""
    unmeasured_velocity: Positive = 1e-2
    """Uncertainty of a velocity that no sensor measures [m/s or rad/s]. Empirical."""
    unknown_position: Positive = 0.1
    """Uncertainty of a coordinate that was not measured of a free body of which others were [m]. Empirical."""
    unknown_velocity: Positive = 0.5
    """Uncertainty of its velocity [m/s]. Empirical."""
    unknown_orientation: Positive = 0.3
    """Uncertainty of an orientation that was not measured of a body whose position was [rad]. Empirical."""
    unknown_spin: Positive = 3.0
    """Uncertainty of its angular velocity [rad/s]. Empirical."""
    min_values: Count = 12
    """Least measured values of a recording that can be compared with a model [-]: one for each block of time."""
    probe_pairs: Count = 6
    """Pairs of simulations from opposite errors of the initial state, from which the length of windows is chosen [-].
    Empirical."""
    max_curvature: Positive = 3.0
    """Deviation of the mean of such a pair from the simulation without an error, over the noise and the numerical
    scatter, at which a window ends [-]: beyond it, the effect of an error is no longer in proportion to it.
    Empirical."""
    max_growth: Factor = 6.0
    """Growth of the effect of an error of the initial state over the second half of a window at which it ends where
    nothing that moves freely can be touched [-]: an unstable machine, as one that a controller balances, amplifies the
    model's errors as it does those, and a window's best initial state is then far from the true one. Empirical."""
    least_growth: Positive = 30.0
    """Effect of such an error, over the noise, below which a window goes on all the same [-]. Empirical."""
    balanced_factor: Factor = 1.5
    """Length of other windows of a motion over that of one that ended so, up to which they may be longer [-].
    Empirical."""
    max_transient: Annotated[float, Bounds(0)] = 0.1
    """Longest time of such deviations that a window goes on after, once [s]: of the rebound of a body on joints without
    drives, which one start has earlier than its opposite, and after which the effect is in proportion again. The body
    of a free joint leaves it with another spin; drives press bodies together again. Empirical."""
    max_scatter_noise: Positive = 5.0
    """Largest numerical scatter that is taken into account there, over the noise [-]: chaotic motion scatters without
    limit. Empirical."""
    max_scatter: float = 2.0
    """Scatter of the samples about a smooth motion over its median below which a window may start [-]: it is larger at
    impacts, where velocities are unknown. Empirical."""
    min_length: PositiveDuration = 0.12
    """Shortest window [s]. Empirical."""
    max_length: PositiveDuration = 20.0
    """Longest window [s], for the simulations' memory."""
    max_contact_length: PositiveDuration = 2.0
    """Longest window of a body that moves freely and can be touched [s]: contacts that are made and broken give a long
    window's cost many local minima, in which errors of its initial state stand in for a wrong friction or mass
    (multiple shooting: Bock 1983). Long enough for a fall of a metre."""
    scatter_samples: Annotated[int, Bounds(0, 10_000, excluded=1)] = 16
    """Simulations from which the numerical scatter of a window's predictions is estimated [-], see `NumericalScatter`;
    0 for none."""
    scatter_offset: Positive = 0.02
    """Standard deviation of the differences of their initial states, in units of the states' spread [-]: small beside
    what is fitted, large enough to shift the instant of each later impact within a time step."""
    chatter: Annotated[float, Bounds(0)] = 5.0
    """Standard deviation that a residual is allowed for what changes without order from reading to reading in these
    simulations, over its own there [-], see `NumericalScatter`; 0 for none. So large that hardly anything is left of
    it: a model is no better for hopping less than another."""
    min_scatter: Positive = 0.1
    """Standard deviation along a direction of the residuals below which scatter is neglected [-]: a hundredth of the
    noise's variance."""
    impact_error: Share = 0.0
    """Standard deviation of each component of the velocity after an impact that no contact law foretells, over the
    change of the velocity [-], see `impact_deviations`; 0 for none."""
    impact_duration_error: Annotated[float, Bounds(0)] = 1.0
    """Standard deviation of the time for which bodies touch in an impact after which they fly, over that in the
    simulation [-]: a rigid contact is one of them away; nothing where `impact_error` is 0."""
    impact_flight: PositiveDuration = 0.02
    """Time that a body has flown before an impact [s]; shorter hops are the chatter of a contact."""
    impact_duration: PositiveDuration = 0.02
    """Time after which an impact is over where the body stays in contact [s]: several time constants of a contact."""
    impact_acceleration: Positive = 0.5
    """Acceleration beside gravity, in units of it, above which a body touches something [-]."""
    impact_velocity: Positive = 0.05
    """Change of the velocity from which a contact counts as an impact [m/s]."""
    default_position_noise: Positive = 1e-3
    """Noise of positions for which it is neither stated nor estimable [m or rad]: of a typical motion capture."""
    default_noise: Positive = 1e-2
    """The same for all other channels [their unit]."""

    def noise_of_unit(self, unit: str) -> float:
        """Return the noise of a channel for which it is neither stated nor estimable, in its unit."""
        return self.default_position_noise if unit in ("m", "rad") else self.default_noise
