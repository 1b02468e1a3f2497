"""Track points of objects in RGB-D video: from images to the recording's point tracks.

    python examples/steps/track_points.py [--seconds 4] [--rate 10]

A camera in Reality films the demonstration of the shape sorter; with a real camera, `image` of the demonstration holds
its frames. What is known besides is the scene and the state in the first frame.
"""

from dataclasses import replace

import numpy as np
import tyro

import concent_warp as cw
from concent_warp.perception.point_tracking import track_points
from concent_warp.reality.record import RealityCfg, record


def main(seconds: float = 4.0, rate: float = 10.0) -> None:
    """Film, track, and print how many points of each object were seen and how far they moved."""
    cfg = RealityCfg()
    sensing = replace(cfg.sensing, images=True, image_rate=rate, image_size=(180, 240))
    filmed = record(replace(cfg, sensing=sensing), [0])[0]
    (camera,) = filmed[0].image.values()
    shown = camera.time <= seconds
    first = replace(camera, time=camera.time[shown], rgb=camera.rgb[shown], depth=camera.depth[shown])
    demonstration = replace(filmed[0], image={"camera": first}, points={})
    tracked = track_points(filmed, demonstration)
    for body, track in tracked.points.items():
        moved = np.nanmedian(np.linalg.norm(track.value[-1] - track.value[0], axis=1))
        seen = track.visible.sum(axis=1).mean()
        print(f"{body}: {seen:.0f} points at a time in {len(track.time)} frames, moved by {100 * moved:.1f} cm")
    recording = cw.Recording(filmed.scene, (replace(tracked, image={}),))
    print(f"a recording of {len(recording[0].points)} bodies' points, ready to fit")


if __name__ == "__main__":
    tyro.cli(main)
