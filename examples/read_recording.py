"""What a recording holds: demonstrations, channels, rates and gaps.

    python examples/read_recording.py RECORDING

The recording is an HDF5 file, a folder of CSV files, or ContactNets tosses; `concent record` writes one to look at.
"""

import sys
from pathlib import Path

import numpy as np

from concent_warp.errors import ConcentError
from concent_warp.recording.load import load_recording
from concent_warp.scene.scene import Scene


def main(path: Path) -> None:
    """Print a line for each channel."""
    recording = load_recording(path)
    print(f"{path}: objects {', '.join(Scene(recording.scene).objects())}")
    for demonstration in recording.demonstrations:
        print(f"{demonstration.name}: {demonstration.task or 'no task given'}, {demonstration.duration:.2f} s")
        for kind in ("action", "measured", "points", "image"):
            for name, stream in getattr(demonstration, kind).items():
                rate = (len(stream.time) - 1) / max(float(np.ptp(stream.time)), 1e-9)
                line = f"  {kind}/{name}: {len(stream.time)} samples, {rate:.0f} Hz"
                if kind == "points":
                    line += f", {stream.visible.shape[1]} points, {100 * stream.visible.mean():.0f} % visible"
                elif kind == "measured":
                    line += f", {100 * np.isnan(stream.value).any(axis=1).mean():.0f} % missing"
                print(line)


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]))
    except ConcentError as error:
        sys.exit(str(error))
