"""What Reality's cameras saw, for benchmarks of rendering: recorded once, and packed for hosts that cannot.

    python -m benchmarks.render.footage --folder runs/render_gap                       record, on a CPU
    python -m benchmarks.render.footage --folder runs/render_gap --pack runs/packed    and pack

The footage is of Reality without objects, for training networks, and with them on trajectories of other seeds,
to judge by; of each object there are photographs under Reality's lights. A packed folder holds the frames as
H.264 of full colour: 10 MB in the place of 230. How much that changes them is printed; where images are judged by
them, it is to be told.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from concent_warp.reality.appearance.surroundings import light
from concent_warp.reality.record import RealityCfg, record
from concent_warp.reality.sensors.footage import FootageCfg, apply_tone_curve
from concent_warp.reality.sensors.photographs import PhotographsCfg, photographs
from concent_warp.recording.formats.hdf5 import read_hdf5, write_hdf5
from concent_warp.recording.recording import Recording
from concent_warp.render.splats.views import FILE, SplatViews

CAMERAS = ("base", "wrist")
OBJECTS = ("block", "box")
EMPTY, HELD = "empty.h5", "held.h5"
QUALITY = {EMPTY: 20, HELD: 10}
"""Constant rate factor of the video: less is better and larger."""


def footage(folder: Path, name: str, demonstrations: int = 8) -> Recording:
    """Return the footage without objects or that to judge by, from the folder if it is there."""
    path = folder / name
    if not path.exists():
        empty = name == EMPTY
        cfg = RealityCfg(footage=FootageCfg(cameras=CAMERAS, objects=not empty, rate=10 if empty else 5))
        seeds = list(range(10, 10 + demonstrations)) if empty else [1, 2]
        write_hdf5(record(cfg, seeds)[0], path)
    recording = read_hdf5(path)
    return with_videos(recording, path) if video(path, CAMERAS[0]).exists() else recording


def photographed(folder: Path, body: str, cfg: PhotographsCfg) -> Path:
    """Return a folder of photographs of an object under Reality's lights, made if they are not there."""
    path = folder / f"photos_{body}"
    if not (path / FILE).exists():
        reality = RealityCfg()
        world = reality.world.build(reality.task.build())
        light(world)
        taken = photographs(world, body, cfg)
        rgba = taken.rgba.copy()
        rgba[..., :3] = np.round(255 * apply_tone_curve(rgba[..., :3] / 255, FootageCfg()))
        SplatViews(rgba, taken.poses, taken.intrinsics, True).write(path)
    return path


def video(path: Path, camera: str) -> Path:
    """Return where the frames of a camera are, beside a recording that has none."""
    return path.with_name(f"{path.stem}_{camera}.mp4")


def pack(folder: Path, out: Path) -> None:
    """Write footage as videos, and beside them the recordings without frames."""
    out.mkdir(parents=True, exist_ok=True)
    for name, quality in QUALITY.items():
        recording = read_hdf5(folder / name)
        for camera in CAMERAS:
            frames = np.concatenate([d.image[camera].rgb for d in recording.demonstrations])
            write_video(video(out / name, camera), frames, quality)
            off = np.stack(list(read_video(video(out / name, camera)))).astype(np.float32) - frames
            print(f"{name}, {camera}: {len(frames)} frames, {-10 * np.log10(np.square(off / 255).mean()):.1f} dB")
        write_hdf5(with_frames(recording, {}), out / name)
    for body in OBJECTS:
        target = out / f"photos_{body}"
        target.mkdir(exist_ok=True)
        for file in (folder / f"photos_{body}").iterdir():
            (target / file.name).write_bytes(file.read_bytes())


def with_frames(recording: Recording, frames: dict[str, Iterator[np.ndarray]]) -> Recording:
    """Return a recording with other frames, black ones where none are given, and no points that were tracked."""
    demonstrations = []
    for one in recording.demonstrations:
        image = {}
        for camera, stream in one.image.items():
            given = [next(frames[camera]) for _ in stream.time] if camera in frames else None
            image[camera] = replace(stream, rgb=np.zeros_like(stream.rgb) if given is None else np.stack(given))
        demonstrations.append(replace(one, image=image, points={}))
    return replace(recording, demonstrations=tuple(demonstrations))


def with_videos(recording: Recording, path: Path) -> Recording:
    """Return a recording with the frames of the videos beside it."""
    return with_frames(recording, {camera: read_video(video(path, camera)) for camera in CAMERAS})


def write_video(path: Path, frames: np.ndarray, quality: int) -> None:
    """Write frames, shape (T, H, W, 3) uint8, without leaving out any of their colour."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10, options={"crf": str(quality), "preset": "slow"})
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv444p"
        stream.codec_context.thread_count = 1
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
        container.mux(stream.encode(None))


def read_video(path: Path) -> Iterator[np.ndarray]:
    """Yield frames, shape (H, W, 3) uint8; by OpenCV, as hosts without a registry have it."""
    import cv2

    reader = cv2.VideoCapture(str(path))
    if not reader.isOpened():
        raise SystemExit(f"OpenCV cannot open {path}")
    while True:
        there, frame = reader.read()
        if not there:
            return
        yield np.ascontiguousarray(frame[..., ::-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("runs/render_gap"))
    parser.add_argument("--demonstrations", type=int, default=8, help="to train from, without objects")
    parser.add_argument("--photo", type=int, default=96, help="edge of the photographs of objects [px]")
    parser.add_argument("--photos", type=int, default=48, help="photographs of an object")
    parser.add_argument("--pack", type=Path, help="folder to pack into")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    for name in QUALITY:
        footage(arguments.folder, name, arguments.demonstrations)
    for body in OBJECTS:
        photographed(arguments.folder, body, PhotographsCfg(size=arguments.photo, count=arguments.photos))
    if arguments.pack is not None:
        pack(arguments.folder, arguments.pack)


if __name__ == "__main__":
    main()
