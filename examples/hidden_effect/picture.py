"""Draw what a diagnosis has found: the gain of each effect, and the error before and after the best was added.

concent diagnose demo.h5 --model scene.xml --apply found.toml --json > found.json
python picture.py found.json demo.h5 scene.xml found.toml picture.png
"""

import json
import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt

from concent_warp.comparison.compare import compare_replays
from concent_warp.model import Model
from concent_warp.recording.load import load_recording

MOST = 7
"""Effects that are drawn."""
GREEN, GREY, RED = "#2b8a3e", "#adb5bd", "#c92a2a"


def main(diagnosis: Path, recording: Path, before: Path, after: Path, out: Path) -> None:
    """Draw and save."""
    found = json.loads(diagnosis.read_text())
    first = [e for e in found["effects"] if e["step"] == 0][:MOST]
    comparison = compare_replays(
        {"before": Model.load(before), "after": Model.load(after)}, load_recording(recording), "mujoco"
    )
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.6), width_ratios=[1, 1.25], layout="constrained")
    for row, e in enumerate(first):
        gain, (low, high) = e["gain"]["value"], e["gain"]["interval"]
        left.barh(row, 100 * gain, color=GREEN if e["accepted"] else GREY)
        left.plot([100 * low, 100 * high], [row, row], color="black", linewidth=1.2)
    left.set_yticks(range(len(first)), [e["name"] for e in first])
    left.invert_yaxis()
    left.set_xlim(0, 100)
    left.set_xlabel("held-out error that it takes away [%]")
    left.set_title("Which effect is missing", loc="left")
    channel = max(
        (r for r in comparison.residuals["before", comparison.demonstrations[0]] if r.ratio is not None),
        key=lambda r: float(r.ratio.mean()),  # pyright: ignore[reportOptionalMemberAccess]
    ).channel
    for name, colour in (("before", RED), ("after", GREEN)):
        residual = comparison.residual(name, comparison.demonstrations[0], channel)
        assert residual is not None
        right.plot(residual.time, residual.ratio, color=colour, linewidth=0.8, label=name)
    right.axhline(1.0, color="black", linewidth=0.8, linestyle=":", label="noise")
    right.set_xlabel("time [s]")
    right.set_ylabel("error / noise")
    right.set_title(f"{channel.replace('_', ' ')}, before and after", loc="left")
    right.legend(frameon=False)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(out, dpi=130)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:6]))
