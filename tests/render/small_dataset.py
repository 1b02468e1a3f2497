"""Episodes of a few small frames; run as a script, it writes them and dies at the k-th file that gets its name."""

import os
import sys
from pathlib import Path

import numpy as np

from concent_warp.render.dataset.layout import EpisodeLayout

LAYOUT = EpisodeLayout(10, ("base", "wrist"), (32, 48), ("a", "b"), ("x", "y", "z"))


def read_frames(path: Path) -> np.ndarray:
    """Return all frames of a video, shape (T, H, W, 3) uint8."""
    import av

    with av.open(str(path)) as container:
        return np.stack([image.to_ndarray(format="rgb24") for image in container.decode(video=0)])


def frame(key: int, t: int) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Return images whose grey tells episode and time, a state and an action."""
    images = {
        camera: np.full((*LAYOUT.size, 3), 20 + 20 * key + 8 * t + 60 * c, dtype=np.uint8)
        for c, camera in enumerate(LAYOUT.cameras)
    }
    return images, np.array([key, t], dtype=float), np.array([key, t, 1.0])


def length(key: int) -> int:
    return 3 + key


def write(writer, keys) -> None:
    for key in keys:
        if writer.has(key):
            continue
        episode = writer.begin(key, f"task {key % 2}")
        for t in range(length(key)):
            episode.add(*frame(key, t))
        episode.save()


if __name__ == "__main__":
    from concent_warp.render.dataset.lerobot import LeRobotWriter

    left = int(sys.argv[2])
    named = {name: getattr(Path, name) for name in ("replace", "rename")}

    def dying(name):
        def call(path, target):
            global left
            left -= 1
            if left == 0:
                os._exit(9)
            return named[name](path, target)

        return call

    for name in named:
        setattr(Path, name, dying(name))
    writer = LeRobotWriter(Path(sys.argv[1]), LAYOUT, video_mb=0.004)
    write(writer, range(5))
    writer.finish()
