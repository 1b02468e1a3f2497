"""Read a data set with the lerobot package, every frame of it, and say what was found as JSON.

To be run by a Python that has lerobot, which pins older versions of torch and NumPy than this project wants.
"""

import argparse
import json
import time
from importlib.metadata import version

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # pyright: ignore[reportMissingImports]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder")
    arguments = parser.parse_args()
    begun = time.perf_counter()
    data = LeRobotDataset("local/rendered", root=arguments.folder, video_backend="pyav")
    opened = time.perf_counter() - begun
    cameras = data.meta.camera_keys
    episodes: dict[int, list[int]] = {}
    brightness = dict.fromkeys(cameras, 0.0)
    for row in range(len(data)):
        frame = data[row]
        episodes.setdefault(int(frame["episode_index"]), []).append(int(frame["frame_index"]))
        assert int(frame["index"]) == row
        assert abs(float(frame["timestamp"]) * data.fps - int(frame["frame_index"])) < 1e-3
        assert torch.isfinite(frame["action"]).all()
        assert isinstance(frame["task"], str)
        for camera in cameras:
            assert tuple(frame[camera].shape) == (3, *data.meta.features[camera]["shape"][:2])
            brightness[camera] += float(frame[camera].mean()) / len(data)
    assert all(frames == list(range(len(frames))) for frames in episodes.values())
    batch = next(iter(torch.utils.data.DataLoader(data, batch_size=8, shuffle=True)))
    stated = {camera: float(data.meta.stats[camera]["mean"].mean()) for camera in cameras}
    assert all(abs(brightness[camera] - stated[camera]) < 0.01 for camera in cameras)
    print(
        json.dumps(
            {
                "lerobot": version("lerobot"),
                "torch": version("torch"),
                "frames": len(data),
                "episodes": len(episodes),
                "fps": data.fps,
                "features": {name: list(value.shape[1:]) for name, value in batch.items() if torch.is_tensor(value)},
                "mean of images": brightness,
                "mean in stats.json": stated,
                "open": opened,
                "read all": time.perf_counter() - begun - opened,
            }
        )
    )


if __name__ == "__main__":
    main()
