"""Settings of the import of logs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

from concent_warp.checks import Bounds, Count, Factor, Length, Positive, PositiveDuration, Rate, Share


@dataclass(frozen=True)
class PlausibilityCfg:
    """Thresholds above which a log contradicts the scene, or itself."""

    range_margin: Positive = 0.35
    """Angle outside a joint's range that zero offsets explain [rad]."""
    outside_share: Share = 0.1
    """Share of samples outside the range, by more than the margin, above which the unit is in doubt [-]."""
    max_joint_speed: Positive = 30.0
    """Speed of a joint that 5 % of the samples may exceed [rad/s]: fast arms reach 10, servos 15."""
    min_motion: Positive = 0.02
    """Standard deviation of a joint's position below which it is not compared with its command or speed [rad, m]."""
    unit_ratio: tuple[float, float] = (180 / math.pi / 1.5, 180 / math.pi * 1.5)
    """Ratio of motions that only degrees beside radians explain [-]."""
    length_ratio: tuple[float, float] = (1000 / 1.5, 1000 * 1.5)
    """Ratio of motions that only millimetres beside metres explain [-]."""
    min_slide: Positive = 0.001
    """Standard deviation of the smaller of these motions below which they are not compared [m, m/s]: a finger that
    holds an object hardly moves, whatever its command."""
    min_correlation: Share = 0.8
    """Correlation of measurement and command from which a negative one means a wrong sign [-]."""
    max_clock_difference: PositiveDuration = 0.5
    """Difference between the delays of two channels, reception less stamp, above which their stamps are of two
    clocks [s]."""
    max_repeated: Share = 0.1
    """Share of samples with the stamp of another one above which a clock stands still [-]."""
    max_back_step: Factor = 3.0
    """Step back of a clock above which it was set or started anew, in median periods of its channel [-]; samples that
    are out of order by less are sorted."""
    depth_bounds: tuple[float, float] = (0.02, 20.0)
    """Medians of depth that RGB-D cameras have [m]."""
    depth_grid: Annotated[int, Bounds(2, 64)] = 12
    """Rows and columns of pixels at which depths are compared with the scene."""
    wrong_ratio: Factor = 1.1
    """Median ratio of measured and expected depth above which a pose or unit is in doubt [-]: calibrated cameras are
    within 2 % where the scene has what they see."""
    right_ratio: Factor = 1.15
    """Median ratio below which another pose or unit may be the right one [-]."""
    better: Factor = 4.0
    """Factor by which the logarithm of that ratio must be smaller than as stated [-]."""
    seen_share: Share = 0.5
    """Share of the depths that must be of the scene for this judgement [-]."""


ImageNumber = Annotated[int, Bounds(0, 999_999)]
"""Number of an image of a BOP scene."""


@dataclass(frozen=True)
class BopCfg:
    """How a scene of a BOP data set is read."""

    first_image: ImageNumber = 0
    """Number of the first image that is read."""
    last_image: ImageNumber = 999_999
    """Number of the last one."""
    rate: Rate = 30.0
    """Images a second, numbers that are left out counted [Hz]: the format has no times."""
    models: str | None = None
    """Folder of the meshes in the data set; ``models`` by default, or what stands for it."""
    truth: bool = True
    """Whether poses of the ground truth become measurements, and those of the first image the initial state."""


@dataclass(frozen=True)
class ImportCfg:
    """How a log is read.

    Example:
        >>> import concent_warp as cw
        >>> cw.ImportCfg(episodes=(0, 3)).episodes
        (0, 3)
    """

    episodes: tuple[int, ...] = ()
    """Numbers of the episodes; all by default."""
    calibration: str | None = None
    """Calibration file; by default what the map names, else ``calibration.json`` beside the log."""
    depth_from: Length = 0.05
    """Distance below which a depth counts as missing [m]: no depth camera measures it."""
    max_pair_delay: PositiveDuration = 0.05
    """Time between colour and depth of one frame above which they are no pair [s]."""
    checked_frames: Count = 5
    """Frames of each camera that are compared with the scene."""
    plausibility: PlausibilityCfg = field(default_factory=PlausibilityCfg)
    """Thresholds of the checks."""
    bop: BopCfg = field(default_factory=BopCfg)
    """Scenes of BOP data sets."""
