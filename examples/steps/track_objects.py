"""Track objects in RGB-D video: from images to the recording's poses and point tracks.

    python examples/steps/track_objects.py [--seconds 4] [--rate 10]

A camera in Reality films the demonstration of the shape sorter; with a real camera, `image` of the demonstration holds
its frames. What is known besides is the scene with the object's shape, and what the joints' encoders read.
"""

from dataclasses import replace

import numpy as np
import tyro

import concent_warp as cw
from concent_warp.reality.record import RealityCfg, record


def main(seconds: float = 4.0, rate: float = 10.0) -> None:
    """Film, track without a first pose, and print what was found and how far it is from the truth."""
    cfg = RealityCfg()
    sensing = replace(cfg.sensing, images=True, image_rate=rate, image_size=(180, 240))
    filmed, truths = record(replace(cfg, sensing=sensing), [0])
    (camera,) = filmed[0].image.values()
    shown = camera.time <= seconds
    first = replace(camera, time=camera.time[shown], rgb=camera.rgb[shown], depth=camera.depth[shown])
    video = replace(filmed, demonstrations=(replace(filmed[0], image={"camera": first}, points={}),))
    tracked = cw.track(video, pose="none")
    for track in tracked.tracks:
        print(track.sentence())
        true = np.array([np.interp(track.time, truths[0].time, column) for column in truths[0].block_position.T]).T
        error = np.linalg.norm(track.pose[:, :3, 3] - true, axis=1)
        moved = np.linalg.norm(track.pose[-1, :3, 3] - track.pose[0, :3, 3])
        print(f"{track.body}: moved by {100 * moved:.1f} cm, error {1e3 * np.nanmean(error):.2f} mm")
    channel = tracked.recording[0].measured["block_position"]
    print(f"measured/block_position: {len(channel.time)} samples with noise {1e3 * (channel.noise_std or 0):.2f} mm")


if __name__ == "__main__":
    tyro.cli(main)
