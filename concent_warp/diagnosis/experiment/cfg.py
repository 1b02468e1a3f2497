"""Settings of the suggested experiment."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

from concent_warp.checks import Bounds, Count, Duration, Positive, PositiveDuration, Rate, Share
from concent_warp.fit.effects.observation_cfg import ObservationCfg


@dataclass(frozen=True)
class MotionMenuCfg:
    """Speeds, sizes and durations of the motions that may be suggested.

    "Empirical" values are ordinary speeds and sizes of table-top robots and objects.
    """

    rate: Rate = 100.0
    """Rate of the suggested commands [Hz]."""
    max_duration: PositiveDuration = 8.0
    """Longest motion [s]. Empirical."""
    instants: Count = 40
    """Instants within a demonstration at which speeds are read."""
    extra_mass: Positive = 1.0
    """Mass of a payload over the mass of the body that carries it [-]. Empirical."""
    sweep_speeds: tuple[Positive, ...] = (0.1, 0.4, 1.0)
    """Speeds of the sweeps over the highest recorded speed [-]: viscous and Coulomb friction differ between speeds."""
    time_scales: tuple[Positive, Positive] = (1.5, 0.5)
    """Speeds at which recorded commands are repeated, over the recorded one [-]."""
    speed_window: PositiveDuration = 0.1
    """Time over which the speed of a command is taken [s]."""
    min_sweep_time: PositiveDuration = 0.25
    """Shortest sweep over the whole range [s]."""
    clearance: float = 5.0
    """Distance by which objects are moved out of the way [m]."""
    lighter_grip: Share = 0.7
    """Share of a gripper's commanded closing in a lighter grip [-]."""
    max_bodies: int = 2
    """Objects for which motions are suggested."""
    settling_time: Duration = 3.0
    """Time in which an object comes to rest [s]."""
    rest_speed: float = 0.05
    """Speed below which an object is at rest [m/s and rad/s]."""
    min_flight_height: float = 0.02
    """Height above its place of rest from which on an object starts in flight [m]."""
    spin_rates: tuple[float, float] = (3.0, 10.0)
    """Rates of spinning in place [rad/s]."""
    drop_heights: tuple[float, float, float] = (0.05, 0.2, 0.6)
    """Heights of drops above the place of rest [m]."""
    drop_tilt: Annotated[float, Bounds(-2 * math.pi, 2 * math.pi)] = 0.5235987755982988
    """Tilt of an object that is to land on an edge [rad]: 30 degrees."""
    slower: Positive = 0.5
    """Slower repetition of a motion, over its speed [-]."""
    faster: Positive = 1.5
    """Faster repetition of a motion, over its speed [-]."""
    min_launch_speed: float = 0.1
    """Slowest launch [m/s]."""
    deceleration: Positive = 1.5
    """Deceleration from which the time of a slide is estimated [m/s^2]: friction of 0.15."""
    min_object_duration: PositiveDuration = 0.5
    """Shortest motion of an object [s]."""
    max_object_duration: PositiveDuration = 2.5
    """Longest motion of an object [s]."""


@dataclass(frozen=True)
class SuggestExperimentCfg:
    """Settings of the suggested experiment.

    Example:
        >>> import concent_warp as cw
        >>> cw.SuggestExperimentCfg(min_separation=2.0).min_separation
        2.0
    """

    max_hypotheses: Count = 4
    """Most hypotheses that are compared; the cost grows with their number."""
    finalists: Count = 8
    """Motions simulated with uncertain initial states, after a ranking of all with known ones."""
    probe: Positive = 0.1
    """Step of the finite difference by which effects of the initial state are computed [standard deviations]."""
    min_separation: float = 1.0
    """RMS difference of two predictions over the noise, below which no experiment is suggested [-]."""
    seed: int = 0
    """Seed of the perturbations that bound how long a motion can be predicted."""
    menu: MotionMenuCfg = field(default_factory=MotionMenuCfg)
    """The motions that may be suggested."""
    observation: ObservationCfg = field(default_factory=ObservationCfg)
    """Noise of readings and uncertainty of initial states; a diagnosis takes its own."""
