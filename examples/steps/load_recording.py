"""Load a recording: its demonstrations, channels, rates and gaps.

    python examples/steps/load_recording.py [RECORDING]

The recording is a file or folder in any format of docs/recording.md; by default one that comes with the package.
"""

import sys
from pathlib import Path

import numpy as np

import concent_warp as cw


def main(path: Path) -> None:
    """Print a line for each channel."""
    recording = cw.load_recording(path)
    print(f"{path}: objects {', '.join(cw.Scene(recording.scene).objects())}")
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
        main(Path(sys.argv[1]) if len(sys.argv) > 1 else cw.example("servo"))
    except cw.ConcentError as error:
        sys.exit(str(error))
