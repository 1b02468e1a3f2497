"""Videos of Reality by the ray tracer of its camera; they need neither display nor OpenGL."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from concent_warp.errors import ConcentError
from concent_warp.files import new_file
from concent_warp.reality.sensors.camera import record_depth_images
from concent_warp.reality.sensors.sensing import SensingCfg

FRAME_SIZE = (240, 320)
"""Height and width of a frame [pixels]."""
CAMERA_OFFSET = (0.57, -0.43, 0.63)
"""Position of the camera relative to its target [m]."""
CAMERA_FOVY = 22.0
"""Vertical field of view [degrees]."""
LAMP_POSITION = (0.2, -0.4, 1.5)
"""Where a light is put in a world that has none [m]."""
CODECS = ("vp09", "mp4v")
"""Codecs of the MP4, by preference: browsers play the first; the second is there wherever OpenCV is."""


def render_video(world: mujoco.MjSpec, bodies: tuple[str, ...], qpos: np.ndarray, period: float) -> np.ndarray:
    """Return frames of a motion, uint8, shape (T, H, W, 3).

    Args:
        world: Reality.
        bodies: Objects; the camera is aimed at the mean of their initial positions.
        qpos: States, shape (T, nq).
        period: Time between them [s].
    """
    world = world.copy()
    if not world.lights:
        world.worldbody.add_light(pos=list(LAMP_POSITION), dir=[0, 0, -1], castshadow=True)
    model = world.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = qpos[0]
    mujoco.mj_kinematics(model, data)
    middle = np.mean([data.body(name).xpos for name in bodies], axis=0)
    place = middle + CAMERA_OFFSET
    camera = replace(
        SensingCfg(),
        camera_position=(float(place[0]), float(place[1]), float(place[2])),
        camera_target=(float(middle[0]), float(middle[1]), float(middle[2])),
        camera_fovy=CAMERA_FOVY,
        image_size=FRAME_SIZE,
        rgb_std=0.0,
    )
    return record_depth_images(camera, world, bodies, period * np.arange(len(qpos)), qpos, np.random.default_rng(0)).rgb


def write_video(path: Path, frames: np.ndarray, rate: float) -> None:
    """Write frames, uint8, shape (T, H, W, 3), as an MP4 at a rate [Hz], in one piece or not at all.

    Raises:
        ConcentError: OpenCV can write no MP4 here.
    """
    import cv2

    height, width = frames.shape[1:3]
    with new_file(path) as partial:
        video = partial.with_name(f"{partial.name}.mp4")  # OpenCV knows the format by the end of the name
        try:
            for codec in CODECS:
                writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*codec), rate, (width, height))
                if writer.isOpened():
                    for frame in frames:
                        writer.write(np.ascontiguousarray(frame[..., ::-1]))
                    writer.release()
                    _check_video(video, len(frames), path)
                    video.replace(partial)
                    return
        finally:
            video.unlink(missing_ok=True)
        raise ConcentError("OpenCV cannot write this video", where=path, expected=f"a codec among {', '.join(CODECS)}")


def _check_video(video: Path, count: int, path: Path) -> None:
    """Raise an error unless a video has all its frames; OpenCV does not say that a disk is full.

    Raises:
        ConcentError: It lacks some; `path` is where it was to go.
    """
    import cv2

    reader = cv2.VideoCapture(str(video))
    found = 0
    while reader.grab():
        found += 1
    reader.release()
    if found != count:
        fix = "make room on the disk, or choose another place"
        raise ConcentError("the video cannot be written", where=path, expected=f"{count} frames", found=found, fix=fix)
