"""Frames of all cameras of a demonstration, grouped into moments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from concent_warp.errors import RecordingError
from concent_warp.perception.pinhole import Pinhole
from concent_warp.perception.tracking.configuration import configurations
from concent_warp.perception.tracking.geometry.ray_renderer import RayRenderer
from concent_warp.perception.tracking.geometry.view import View
from concent_warp.recording.recording import Demonstration, ImageStream


@dataclass(frozen=True)
class Video:
    """RGB-D streams of a demonstration with the robot's configuration at their times."""

    time: np.ndarray
    """Times of the moments [s], shape (T,)."""
    frames: list[list[tuple[int, int]]]
    """For each moment, camera and frame."""
    streams: list[ImageStream]
    qpos: np.ndarray
    """Robot's configuration, shape (T, nq)."""
    unmeasured: list[str]
    """Joints that nothing tells about."""
    names: tuple[str, ...] = ()
    """Cameras of the streams."""

    @staticmethod
    def of(
        model: mujoco.MjModel, demonstration: Demonstration, cameras: Sequence[str], simultaneous: float, where: str
    ) -> Video:
        """Return the frames of some cameras, all where none are named.

        Raises:
            RecordingError: There is no such camera, or none with depth.
        """
        names = list(demonstration.image)
        if unknown := [c for c in cameras if c not in names]:
            raise RecordingError("no such camera", where=where, expected=f"some of {names}", found=unknown)
        with_depth = [n for n in cameras or names if (demonstration.image[n].depth > 0).any()]
        if not with_depth:
            raise RecordingError(
                "there is no RGB-D video to track objects in",
                where=where,
                expected="an image channel with depth",
                found="no image channel" if not names else f"no depth in {list(cameras) or names}",
                fix="record /image/<camera> with depth, see docs/recording.md",
            )
        streams = [demonstration.image[n] for n in with_depth]
        every = sorted((float(t), c, k) for c, s in enumerate(streams) for k, t in enumerate(s.time))
        groups: list[list[tuple[float, int, int]]] = []
        for frame in every:
            taken = {c for _, c, _ in groups[-1]} if groups else set()
            if groups and frame[0] - groups[-1][0][0] <= simultaneous and frame[1] not in taken:
                groups[-1].append(frame)
            else:
                groups.append([frame])
        time = np.array([np.mean([f[0] for f in group]) for group in groups])
        qpos, unmeasured = configurations(model, demonstration, time)
        return Video(
            time, [[(c, k) for _, c, k in group] for group in groups], streams, qpos, unmeasured, tuple(with_depth)
        )

    def views(self, moment: int, renderer: RayRenderer) -> list[View]:
        """Return the frames of a moment; the renderer is in its state."""
        result = []
        for c, k in self.frames[moment]:
            stream = self.streams[c]
            camera = Pinhole.of(stream)
            if stream.body is not None:
                carrier = renderer.pose(renderer.model.body(stream.body).id)
                camera = replace(camera, pose=carrier @ camera.pose)
            result.append(View(camera, stream.rgb[k], stream.depth[k]))
        return result
