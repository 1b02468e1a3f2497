"""Settings of what follows objects in images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from concent_warp.checks import Bounds, Count, Positive, PositiveShare, Share


@dataclass(frozen=True)
class FlowTrackerCfg:
    """Settings of the optical flow of points.

    Example:
        >>> import concent_warp as cw
        >>> cw.FlowTrackerCfg().levels
        3
    """

    half_window: Annotated[int, Bounds(2, 50)] = 7
    """Half edge of the window that is compared [px]."""
    levels: Annotated[int, Bounds(0, 8)] = 3
    """Levels of the image pyramid above the image itself: each doubles the motion that is followed."""
    max_return_error: Positive = 0.7
    """Distance from its start, after tracking there and back, above which a point is lost [px]."""
    max_drift: Positive = 2.0
    """Distance between a point followed from frame to frame and the same point compared with its first frame within
    which the latter, which does not drift, is taken [px]."""
    spacing: Positive = 5.0
    """Least distance between chosen points [px]."""
    quality: PositiveShare = 0.01
    """Least corner response over the largest of a chosen point [-] (Shi and Tomasi, "Good features to track",
    1994)."""


@dataclass(frozen=True)
class FeatureTrackerCfg:
    """Settings of keypoints that are matched to those of the first frame.

    Example:
        >>> import concent_warp as cw
        >>> cw.FeatureTrackerCfg().matcher
        'nearest'
    """

    matcher: Literal["nearest", "lightglue"] = "nearest"
    """Matches are mutual nearest neighbours, or those of LightGlue, as trained for XFeat."""
    keypoints: Count = 1024
    """Keypoints of an image at most."""
    threshold: PositiveShare = 0.02
    """Least response of a keypoint [-]."""
    min_similarity: Share = 0.82
    """Least cosine between the descriptors of nearest neighbours [-], as the authors have it."""
    min_confidence: Share = 0.1
    """Least confidence of a match of LightGlue [-], as the authors have it."""
    margin: Count = 48
    """Width around the points of the last frame in which they are looked for [px]; in the whole image where too few are
    found."""
    min_matches: Count = 8
    """Matches below which the whole image is searched."""
    zoom: Annotated[float, Bounds(0.25, 8)] = 2.0
    """Magnification of the part of the image that is searched [-]."""
    max_refinement: Positive = 1.5
    """Distance from a match within which optical flow finds the point between the pixels [px]; keypoints lie on pixels
    of the magnified image."""
    spacing: Positive = 5.0
    """Least distance between chosen points [px]."""


@dataclass(frozen=True)
class TapirTrackerCfg:
    """Settings of TAPIR.

    Example:
        >>> import concent_warp as cw
        >>> cw.TapirTrackerCfg().longest_edge
        512
    """

    longest_edge: Annotated[int, Bounds(64, 4096)] = 512
    """Edge that larger images are scaled down to [px]; the model was trained on 256."""
    min_visible: PositiveShare = 0.5
    """Least probability that a point is seen and its position is right [-], as the authors' demonstration has it."""
    causal: bool = False
    """Whether the weights are those of the causal model, which looks at no later frame."""
    spacing: Positive = 5.0
    """Least distance between chosen points [px]."""
    quality: PositiveShare = 0.01
    """Least corner response over the largest of a chosen point [-]."""


@dataclass(frozen=True)
class DepthMaskerCfg:
    """Settings of masks from depth.

    Example:
        >>> import concent_warp as cw
        >>> cw.DepthMaskerCfg().depth_jump
        0.01
    """

    foreground: Positive = 0.006
    """Distance in front of robot and static scene from which on a pixel belongs to an object [m]."""
    depth_jump: Positive = 0.01
    """Difference of depth between neighbouring pixels that separates two objects [m]."""
    reach: Count = 32
    """Distance that an object moves from frame to frame at most, per 640 pixels of the image's width [px]; where it was
    not seen in between, as many times that as frames have passed."""
    depth_reach: Positive = 0.03
    """The same along the line of sight [m]."""
    min_pixels: Count = 20
    """Least number of pixels of an object that is seen."""
    max_growth: Positive = 1.3
    """Pixels over the most that the object had, up to which what its mask lies on is the object as a whole [-]."""


@dataclass(frozen=True)
class Sam2MaskerCfg:
    """Settings of SAM 2.

    Example:
        >>> import concent_warp as cw
        >>> cw.Sam2MaskerCfg().min_logit
        0.0
    """

    min_logit: Annotated[float, Bounds(-100, 100)] = 0.0
    """Logit of a pixel above which it belongs to the object [-]."""
    min_presence: Annotated[float, Bounds(-100, 100)] = 0.0
    """Logit of the object's presence below which its mask is empty [-]."""
    memory: Annotated[int, Bounds(17, 10_000)] = 32
    """Former frames whose results are kept: the model looks at 7 masks and 16 object pointers."""
