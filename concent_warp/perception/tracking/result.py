"""What tracking returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from concent_warp.recording.recording import Recording

TRACKED, FILLED, BRIDGED, LOST = "tracked", "filled", "bridged", "lost"
"""States of a body in a moment."""


@dataclass(frozen=True)
class TrackQuality:
    """What the frames of each moment say about the pose of a body.

    Residuals are those of the pose of this moment alone, before smoothing. Of several cameras that see the body, the
    largest scatter is given.

    Example:
        >>> import concent_warp as cw
        >>> import numpy as np
        >>> one = np.ones(1)
        >>> quality = cw.TrackQuality(("tracked",), ("",), 1e-3 * one, one, one, 0.9 * one, 0.95 * one, one)
        >>> quality.state
        ('tracked',)
    """

    state: tuple[str, ...]
    """State of the body in each moment, T of them: "tracked"; "filled", found backward from a later moment; "bridged",
    interpolated by the smoothing over a short gap; "lost"."""
    reason: tuple[str, ...]
    """Why no pose was accepted in each moment as the video went on, T of them; empty where one was."""
    depth_residual: np.ndarray
    """Scatter of measured minus predicted depth [m], shape (T,), robust (1.48 times the median of the absolute
    differences); NaN, as all that follows, where the pose was not found in the moment's frames."""
    edge_residual: np.ndarray
    """The same of the image's edges, along the normals of contour and creases [px], shape (T,)."""
    texture_residual: np.ndarray
    """The same of texture points [px], shape (T,); NaN without texture."""
    texture_correlation: np.ndarray
    """Mean correlation of a keyframe's visible patches with the image [-], shape (T,); NaN without texture."""
    agreement: np.ndarray
    """Share of the body's pixels with depth, of those that nothing known covers, that agree [-], shape (T,)."""
    visible: np.ndarray
    """Share of the outline that nothing known covers [-], shape (T,)."""


@dataclass(frozen=True)
class BodyTrack:
    """Poses of one body in one demonstration.

    Example:
        >>> import concent_warp as cw
        >>> import numpy as np
        >>> found, lost = np.eye(4), np.full((4, 4), np.nan)
        >>> poses, covariances = np.array([found, lost]), np.tile(1e-6 * np.eye(6), (2, 1, 1))
        >>> track = cw.BodyTrack("demo_0", "block", np.array([0.0, 0.1]), poses, covariances, "none", True)
        >>> track.lost
        array([False,  True])
    """

    demonstration: str
    body: str
    time: np.ndarray
    """Times of the frames [s], shape (T,)."""
    pose: np.ndarray
    """Body-to-world transforms, shape (T, 4, 4); NaN where the body is lost."""
    covariance: np.ndarray
    """Covariances of position [m^2] and rotation vector [rad^2], both along the world's axes, shape (T, 6, 6)."""
    symmetry: str
    """Rotations that the shape leaves open, in words; "none" where there are none."""
    textured: bool
    """Whether texture was found, which fixes rotations that the shape leaves open."""
    reason: str = ""
    """Why the body was not found last, where it was lost."""
    quality: TrackQuality | None = None
    """What the frames of each moment say about the pose; `track` gives it."""
    cameras: tuple[str, ...] = ()
    """Cameras that the body was tracked with; empty where that is not known."""
    common: np.ndarray | None = None
    """What of the covariances all moments share: change of position [m] and rotation vector [rad], per standard
    deviation of errors that do not change from frame to frame, as of the camera's depth, shape (T, 6, E); None where
    unknown."""

    @property
    def lost(self) -> np.ndarray:
        """Whether the body is lost, shape (T,) bool."""
        return ~np.isfinite(self.pose[:, 0, 0])

    def sentence(self) -> str:
        """Return the result in words."""
        kept = ~self.lost
        if not kept.any():
            return f"{self.demonstration}, {self.body}: not found; {self.reason}"
        std = np.sqrt(np.einsum("tii->ti", self.covariance[kept]))
        position, rotation = 1e3 * np.median(std[:, :3].max(axis=1)), np.degrees(np.median(std[:, 3:].max(axis=1)))
        text = f"{self.demonstration}, {self.body}: in {kept.sum()} of {len(kept)} frames"
        text += f", std {position:.2f} mm and {rotation:.2f} degrees"
        if self.symmetry != "none":
            open_to = "fixed by the texture from the first frame on" if self.textured else "open: no texture was found"
            text += f"; symmetry of the shape ({self.symmetry}) {open_to}"
        return text


@dataclass(frozen=True)
class Tracked:
    """Objects tracked in the video of a recording.

    Example:
        >>> import concent_warp as cw
        >>> cw.Tracked.__name__
        'Tracked'
    """

    recording: Recording
    """The recording with poses, their covariances and point tracks of the bodies."""
    tracks: tuple[BodyTrack, ...]
    """Of each demonstration, each body."""
    remarks: tuple[str, ...] = ()
    """What the user should know, such as joints that nothing measures."""

    def track(self, body: str, demonstration: str | int = 0) -> BodyTrack:
        """Return the track of a body in a demonstration, by its name or position."""
        name = self.recording[demonstration].name
        return next(t for t in self.tracks if t.body == body and t.demonstration == name)
