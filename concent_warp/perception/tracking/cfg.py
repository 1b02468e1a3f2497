"""Settings of the tracking of objects in RGB-D video."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from concent_warp.checks import Angle, Bounds, Count, Positive, PositiveShare, Share


@dataclass(frozen=True)
class AlignCfg:
    """Settings of the refinement of a pose in one frame."""

    iterations: Count = 4
    """Gauss-Newton iterations of a frame that continues a track."""
    first_iterations: Count = 14
    """Gauss-Newton iterations of a pose that is only roughly known."""
    max_pixels: Count = 1200
    """Pixels of the object that depth is compared in; where it covers more, a regular grid of them."""
    max_edge_samples: Count = 160
    """Points on contour and creases that edges are searched at."""
    edge_range: Positive = 4.0
    """Distance from the predicted edge within which the image's edge is searched [px]."""
    first_edge_range: Positive = 12.0
    """The same at the start of a rough pose [px]."""
    depth_gate: Positive = 0.012
    """Difference between measured and predicted depth above which a pixel is left out [m]."""
    first_depth_gate: Positive = 0.04
    """The same at the start of a rough pose [m]."""
    gate_noise: Positive = 4.0
    """The same over the noise of depth at the object's distance, where that is more, as for a camera far away [-]."""
    min_depth_std: Positive = 2e-4
    """Least scatter of depth that is believed [m]: of the order of a sensor's step."""
    min_edge_std: Positive = 0.25
    """Least scatter of edges that is believed [px]."""
    min_texture_std: Positive = 0.1
    """Least scatter of texture points that is believed [px]."""
    max_step: Positive = 0.015
    """Largest translation of one iteration [m]; rotations are limited to this over the object's radius [rad]."""
    depth_tilt_std: float = 1e-4
    """Standard deviation of the change of that offset across the object's reach, in either direction of the image
    [1/m]: a sensor's distortion changes slowly over the image (Teichman et al., "Unsupervised intrinsic calibration of
    depth sensors via SLAM", RSS 2013). It enters the covariance, not the pose."""
    depth_bias_std: float = 3e-4
    """Standard deviation of a common offset of inverse depth [1/m], 0.3 mm at 1 m: calibrated depth cameras state 1 to
    2 % at 1 m or more at delivery and 0.1 % or less after calibration. It enters the covariance, not the pose."""
    edge_bias_std: float = 0.15
    """Standard deviation of an offset that all edges on one side of the object have in common [px]: blur and light move
    them. It enters the covariance, not the pose."""
    slant: Share = 0.15
    """Least cosine between line of sight and normal at which depth is used [-]."""
    outlier_factor: Positive = 4.685
    """Residual over scatter from which on a residual has no weight [-]; Tukey's constant for 95 % efficiency."""


@dataclass(frozen=True)
class AcceptCfg:
    """When a pose agrees with a frame; otherwise the object is lost in it."""

    depth_tolerance: Positive = 0.006
    """Difference of depth within which a pixel agrees [m]; four times the scatter where that is more."""
    min_agreement: PositiveShare = 0.7
    """Least share of the pixels with depth, of those not hidden by known bodies, that agree [-]."""
    max_behind: Share = 0.15
    """Largest share of those pixels that see through the object [-]."""
    max_unexplained: Share = 0.2
    """Largest share of the pixels just outside the outline that something unknown, as near as the object, covers
    [-]."""
    max_misfit: Positive = 1e-3
    """Largest scatter of the difference of depth, averaged over squares of 7 pixels [m]: errors of sensor and shape."""
    max_misfit_share: Share = 0.6
    """The same as a share of the scatter by pixel, where that is more [-]: what averaging leaves of noise."""
    min_texture: Share = 0.5
    """Least mean correlation of a keyframe's patches with the image [-]."""
    max_penetration: Positive = 0.005
    """Depth in other bodies above which a pose that was searched for is impossible [m]: joint readings and shapes are
    not exact."""
    max_followed_penetration: Positive = 0.03
    """The same for a body that is followed from frame to frame [m]: what it meets may give way, and more so in an
    impact."""
    min_pixels: Count = 30
    """Least number of agreeing pixels."""
    min_visible: Share = 0.12
    """Least share of the outline that known bodies leave visible [-]."""
    max_translation_std: Positive = 0.01
    """Largest standard deviation of a position, along the worst direction, of a pose that is reported [m]."""


@dataclass(frozen=True)
class TextureCfg:
    """Settings of texture points on keyframes."""

    points: Count = 60
    """Points of a keyframe."""
    min_points: Count = 8
    """Least number of points of a keyframe; a view with fewer has no texture."""
    half_patch: Annotated[int, Bounds(2, 50)] = 4
    """Half edge of the patch around a point [px]."""
    spacing: Positive = 5.0
    """Least distance between points [px]."""
    min_spacing: Positive = 2.5
    """The same on a body that is too small for so many points at that distance [px]."""
    min_contrast: Positive = 4.0
    """Least standard deviation of a patch over the image's noise [-]."""
    min_correlation: PositiveShare = 0.75
    """Least normalised correlation of a patch with the keyframe's [-]."""
    max_shift: Positive = 4.0
    """Largest shift of a point from its prediction [px]."""
    search_range: Positive = 12.0
    """Largest shift of all points together from their prediction [px]."""
    max_angle: Angle = 25.0
    """Turn of the object, as the camera sees it, from which on another keyframe is taken [deg]."""
    max_keyframes: Count = 40
    """Keyframes kept."""


@dataclass(frozen=True)
class SearchCfg:
    """Settings of the search for a pose without prior."""

    reach: Positive = 0.06
    """Distance around the predicted pose in which points are looked for before the object counts as lost [m]."""

    across: Count = 40
    """Pixels across the whole object, at the scene's median depth, that the search looks at; where the image has more,
    a regular grid of them."""
    foreground: Positive = 0.006
    """Distance in front of robot and static scene from which on a pixel belongs to an object [m]."""
    depth_jump: Positive = 0.02
    """Difference of depth between neighbouring pixels that separates two objects [m]."""
    foreground_noise: Positive = 4.0
    """Both of them over the noise of depth there, where that is more, as for a camera far away [-]."""
    min_cluster: Count = 24
    """Least number of such pixels of an object."""
    orientations: Count = 160
    """Orientations that are tried."""
    points: Count = 150
    """Measured points of a cluster that are compared with the shape."""
    rounds: Count = 15
    """Iterations of each start."""
    looked_at: Count = 48
    """Aligned starts of a cluster, the best ones that differ, that are compared with the depth image."""
    kept: Count = 12
    """Starts, the best ones that differ, that are refined against the image."""
    finalists: Count = 5
    """Refined poses, the best ones that differ, that are refined until they no longer move, and compared."""
    rivals: Count = 8
    """Large turns of the best pose, and as many small ones, those that explain most of the depth, that are refined and
    compared with it."""
    min_margin: Positive = 0.06
    """Least advantage in score of the best pose over the next that no symmetry of the shape explains [-]."""
    min_votes: Count = 30
    """Least number of pixels at which two poses predict different depths that decide between them, whatever the
    scores."""
    min_majority: PositiveShare = 0.7
    """Least excess of those pixels that are nearer to the one pose over those nearer to the other [-]."""
    min_divided_margin: Positive = 0.2
    """Least advantage in score, whatever known bodies cover, where such pixels are divided between two poses [-]."""
    same_translation: Positive = 0.006
    """Distance below which two poses are the same [m]."""
    same_rotation: Angle = 8.0
    """Turn below which two poses are the same [deg]."""
    interval: Positive = 0.3
    """Time between searches while an object is lost [s]."""


@dataclass(frozen=True)
class RegistrationCfg:
    """Settings of poses from tracked points."""

    points: Count = 80
    """Points of a keyframe in each camera."""
    min_points: Annotated[int, Bounds(4, 10_000)] = 8
    """Least number of points that agree with a pose, and of a keyframe."""
    border: Count = 3
    """Distance from the body's outline within which no point is chosen [px]."""
    hypotheses: Count = 64
    """Poses from three points each that are compared (random sample consensus)."""
    tolerance: Positive = 0.006
    """Distance within which a point agrees with a pose [m]: some standard deviations of a camera's depth at 1 m."""
    max_scatter: Positive = 0.6
    """Largest scatter of the pixels of points that agree with a pose [px]: points that something drags along do not
    move as one body."""
    inflation: Annotated[float, Bounds(1, 1000)] = 8.0
    """Factor of the variance of tracked pixels [-]: their errors last over frames."""
    iterations: Count = 6
    """Gauss-Newton iterations on the pixels and depths of the points that agree."""
    window: Count = 30
    """Frames that points are followed through from their keyframe."""
    min_share: PositiveShare = 0.5
    """Share of the keyframe's points below which a new keyframe is made [-]."""
    shape: bool = True
    """Whether each pose is weighed with depth and edges of the shape, as that of a keyframe always is."""
    fallback: bool = True
    """Whether the model-to-frame tracker follows the body where too few points agree."""


@dataclass(frozen=True)
class SmoothCfg:
    """Settings of the forward-backward smoothing."""

    acceleration: Annotated[tuple[float, ...], Bounds(above_low=True)] = (0.02, 0.2, 2.0, 20.0)
    """Standard deviations of the acceleration within one frame that are compared [m/s^2]; for rotations over the
    object's radius. Each stretch of the motion takes the most likely."""
    impact: Positive = 500.0
    """The same in single steps in which the velocity jumps, as where a ball bounces [m/s^2]."""
    surprising: PositiveShare = 0.9999
    """Probability, were the motion smooth, of a smaller distance of a measurement from its prediction than there is in
    such a step [-]."""
    window: Positive = 0.3
    """Time over which their likelihoods are averaged [s]."""
    max_gap: float = 0.15
    """Longest time without a measurement that is bridged [s]; longer gaps are NaN."""


@dataclass(frozen=True)
class TrackCfg:
    """Settings of tracking.

    Example:
        >>> import concent_warp as cw
        >>> cw.TrackCfg().align.iterations
        4
    """

    align: AlignCfg = field(default_factory=AlignCfg)
    """Refinement of a pose in a frame."""
    accept: AcceptCfg = field(default_factory=AcceptCfg)
    """When a pose is accepted."""
    texture: TextureCfg = field(default_factory=TextureCfg)
    """Texture points."""
    search: SearchCfg = field(default_factory=SearchCfg)
    """First pose without prior, and recovery."""
    registration: RegistrationCfg = field(default_factory=RegistrationCfg)
    """Poses from tracked points."""
    smooth: SmoothCfg = field(default_factory=SmoothCfg)
    """Smoothing over time."""
    points: Count = 64
    """Surface points of each object that are written as its point track."""
    max_first_translation: Positive = 0.03
    """Correction of a given first pose above which it is refused [m]."""
    max_first_rotation: Annotated[float, Bounds(0, 180)] = 25.0
    """Correction of a given first pose above which it is refused [deg]."""
    simultaneous: float = 0.002
    """Difference in time below which frames of several cameras are one moment [s]."""
    symmetry_tolerance: PositiveShare = 0.01
    """Difference over the object's radius below which a turned shape is the same [-]."""
    seed: Annotated[int, Bounds(0, 2**32 - 1)] = 0
    """Seed of sampled surface points and orientations."""
