"""Write data sets with the lerobot package, and what the package itself reads of them.

To be run by a Python that has lerobot, which pins older versions of torch than this project wants. Each data set has
colours, depths, a state and an action; `truth.npz` beside it has what lerobot reads, frame by frame.
"""

import argparse
import json
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # pyright: ignore[reportMissingImports]

NAMES = ["shoulder.pos", "elbow.pos", "gripper.pos"]
IMAGE = ["height", "width", "channels"]


def write(folder: Path, seed: int, size: tuple[int, int], episodes: int) -> None:
    """Write a data set of random smooth motions, pictures and depths."""
    rng = np.random.default_rng(seed)
    height, width = size
    features = {
        "observation.state": {"dtype": "float32", "shape": (3,), "names": NAMES},
        "action": {"dtype": "float32", "shape": (3,), "names": NAMES},
        "observation.images.front": {"dtype": "video", "shape": (height, width, 3), "names": IMAGE},
        "observation.images.front_depth": {
            "dtype": "video", "shape": (height, width, 1), "names": IMAGE, "info": {"is_depth_map": True},
        },
    }  # fmt: skip
    data = LeRobotDataset.create(f"local/seed{seed}", fps=30, features=features, root=folder, use_videos=True)
    rows, columns = np.mgrid[:height, :width]
    for number in range(episodes):
        phase = rng.uniform(0, 6, 3)
        for t in range(int(rng.integers(30, 60))):
            state = (40 * np.sin(0.1 * t + phase) + [0, 0, 50]).astype(np.float32)
            depth = 400 + 300 * np.sin(columns / width * 3 + 0.05 * t) + 200 * rows / height + rng.normal(0, 3, size)
            depth = depth.astype(np.uint16)[..., None]
            depth[rng.random(size) < 0.05] = 0
            picture = (127 + 120 * np.sin(np.stack([rows, columns, rows + columns], -1) / 9 + 0.2 * t)).astype(np.uint8)
            frame = {"observation.state": state, "action": state + 1, "task": f"task {number % 2}"}
            data.add_frame(frame | {"observation.images.front": picture, "observation.images.front_depth": depth})
        data.save_episode()
    data.finalize()


def read(folder: Path) -> dict[str, np.ndarray]:
    """Return what lerobot reads: numbers, colours and depths [m] of all frames."""
    data = LeRobotDataset("local/read", root=folder, video_backend="pyav", depth_output_unit="m")
    found: dict[str, list[np.ndarray]] = {}
    for row in range(len(data)):
        frame = data[row]
        for name in ("observation.state", "action", "timestamp", "episode_index"):
            found.setdefault(name, []).append(frame[name].numpy())
        color = frame["observation.images.front"].numpy()
        found.setdefault("color", []).append(np.rint(color.transpose(1, 2, 0) * 255).astype(np.uint8))
        found.setdefault("depth", []).append(frame["observation.images.front_depth"].numpy()[0])
        found.setdefault("task", []).append(np.array(frame["task"]))
    return {name: np.stack(values) for name, values in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--size", type=int, nargs=2, default=(120, 160))
    arguments = parser.parse_args()
    begun = time.perf_counter()
    frames = 0
    for seed in arguments.seeds:
        folder = arguments.folder / f"seed{seed}"
        write(folder, seed, tuple(arguments.size), arguments.episodes)
        found = read(folder)
        frames += len(found["timestamp"])
        np.savez(arguments.folder / f"seed{seed}.npz", **found)  # pyright: ignore[reportArgumentType]
    print(json.dumps({"lerobot": version("lerobot"), "frames": frames, "seconds": time.perf_counter() - begun}))


if __name__ == "__main__":
    main()
