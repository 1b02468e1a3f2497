"""Thresholds of the checks of a recording. They are chosen so that sound recordings pass."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from concent_warp.checks import MAX_COUNT, Bounds, Count, Positive, PositiveDuration, Share


@dataclass(frozen=True)
class ClockCheckCfg:
    """Thresholds of the check that clocks are in seconds and start together."""

    min_samples: Count = 10
    """Samples below which a channel is not judged [-]: a state before and one after are a sound recording."""
    slow_period: PositiveDuration = 0.95
    """Sampling period that no measurement of a contact has, but that one in milliseconds has at up to 1 kHz [s]."""
    fast_period: Positive = 1e-6
    """Sampling period below which a clock cannot be in seconds [s]: no sensor of a robot is read at 1 MHz."""
    max_span_ratio: float = 10.0
    """Duration of a slow channel over that of the fast ones above which its clock is in another unit, and first sample
    of a demonstration over its duration above which its clock was not set to 0 [-]."""
    late_start: float = 60.0
    """First sample of a demonstration above which its clock may be one that was not set to 0 [s]."""
    short_gap: float = 1.0
    """Time without any sample that is never refused [s]."""


@dataclass(frozen=True)
class FallCfg:
    """Thresholds above which a motion is taken for a free fall."""

    min_share: Share = 0.25
    """Least share of a track in which its acceleration is that of gravity [-]."""
    max_error: float = 0.25
    """Largest deviation of that acceleration from gravity, as a share of it [-]: air drag at half the final speed."""
    span: PositiveDuration = 0.25
    """Length of the pieces of which each acceleration is estimated [s], or `min_samples` periods if these are more:
    noise of 5 mm at 30 Hz leaves an error of 0.8 m/s^2."""
    min_samples: Annotated[int, Bounds(3, MAX_COUNT)] = 6
    """Fewest samples of such a piece [-]."""
    margin: float = 1.5
    """Distance that the demonstration may reach, as a multiple of the largest in the fall [-]."""


@dataclass(frozen=True)
class UnitCheckCfg:
    """Thresholds of the check for millimetres in place of metres and degrees in place of radians."""

    max_distance: float = 20.0
    """Distance from the origin that is never refused [m]: larger than a room."""
    max_extents: float = 50.0
    """Distance from the origin, in extents of the scene, that is never refused [-]."""
    max_turn: float = 2 * np.pi
    """Largest angle of a joint outside its range [rad]: encoders that wrap stay within a full turn."""
    max_slide: float = 1.0
    """Position of a slide joint outside its range that is never refused [m]."""
    max_slide_ranges: float = 5.0
    """Position of a slide joint outside its range, in ranges, that is never refused [-]."""
    max_speed: float = 340.0
    """Largest speed [m/s]: that of sound."""
    fall: FallCfg = field(default_factory=FallCfg)
    """Free falls, which may be from any height."""


@dataclass(frozen=True)
class ValidateCfg:
    """Thresholds of the checks of a recording."""

    quaternion_tolerance: float = 0.05
    """Largest deviation of the norm of a measured or initial quaternion from 1 [-]: rounding and additive noise stay
    below it, Euler angles, zeros and degrees do not."""
    rotation_tolerance: float = 1e-3
    """Largest deviation of R R^T from the unit matrix [-]: calibrations are printed with four digits and more."""
    clocks: ClockCheckCfg = field(default_factory=ClockCheckCfg)
    """Check of the clocks."""
    units: UnitCheckCfg = field(default_factory=UnitCheckCfg)
    """Check of the units."""
