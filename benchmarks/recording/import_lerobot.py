"""Write data sets with the lerobot package, in another environment, and compare what it and `import_log` read of them.

    python -m benchmarks.recording.import_lerobot --lerobot /path/to/its/python

lerobot 0.6 needs Python 3.12 and an older torch: `python3.12 -m venv lerobot && lerobot/bin/pip install
"lerobot[dataset]==0.6.1"`. With --table the page is written from the stored result.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pages import FOLDER, machine
from concent_warp.files import write_text
from concent_warp.recording.logs.cfg import ImportCfg, PlausibilityCfg
from concent_warp.recording.logs.import_log import import_log
from concent_warp.recording.recording import Recording

DATA = FOLDER / "data" / "import_lerobot.jsonl"
PAGE = FOLDER / "import_lerobot.md"
SEEDS = tuple(range(101, 121))
JOINTS = ("shoulder", "elbow", "gripper")
SCENE = f"""
<mujoco>
  <worldbody>
    {"".join(f'<body name="{n}"><joint name="{n}" range="-180 180"/><geom size="0.01"/></body>' for n in JOINTS)}
  </worldbody>
  <actuator>{"".join(f'<position name="{n}" joint="{n}" kp="1"/>' for n in JOINTS)}</actuator>
  <sensor>{"".join(f'<jointpos name="{n}" joint="{n}"/>' for n in JOINTS)}</sensor>
</mujoco>
"""
MAP = """
[action."*"]
source = "action/*.pos"
unit = "deg"
[measured."*"]
source = "observation.state/*.pos"
unit = "deg"
[image.front]
color = "observation.images.front"
depth = "observation.images.front_depth"
pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]]
"""


def compared(recording: Recording, truth: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the largest differences between an imported data set and what lerobot reads of it."""
    found: dict[str, float] = dict.fromkeys(("time", "state", "action", "color", "depth"), 0.0)
    wrong_tasks = 0
    for number, one in enumerate(recording.demonstrations):
        rows = truth["episode_index"] == number
        wrong_tasks += one.task != truth["task"][rows][0]
        stream = one.image["front"]
        stated = np.where(truth["depth"][rows] > 0.05, truth["depth"][rows], 0)
        differences: dict[str, Any] = {
            "time": stream.time - truth["timestamp"][rows],
            "color": stream.rgb.astype(int) - truth["color"][rows],
            "depth": stream.depth - stated,
        }
        for k, joint in enumerate(JOINTS):
            differences[f"state {k}"] = (
                np.rad2deg(one.measured[joint].value[:, 0]) - truth["observation.state"][rows, k]
            )
            differences[f"action {k}"] = np.rad2deg(one.action[joint].value) - truth["action"][rows, k]
        for name, difference in differences.items():
            kind = name.split(" ", maxsplit=1)[0]
            found[kind] = max(found[kind], float(np.abs(difference).max()))
    return found | {"wrong tasks": wrong_tasks}


def measure(python: Path, seeds: tuple[int, ...]) -> dict[str, Any]:
    """Write, read and compare the data sets of some seeds."""
    place = Path(tempfile.mkdtemp())
    try:
        script = Path(__file__).with_name("import_lerobot_write.py")
        environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
        environment |= {"HF_HUB_OFFLINE": "1", "HF_HOME": str(place / ".cache")}
        command = [str(python), str(script), str(place), "--seeds", *map(str, seeds)]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False, timeout=1800)
        if done.returncode != 0:
            raise SystemExit(f"lerobot could not write the data sets:\n{done.stderr[-3000:]}")
        facts = json.loads(done.stdout.strip().splitlines()[-1])
        (place / "scene.xml").write_text(SCENE)
        (place / "map.toml").write_text(MAP)
        camera = {"intrinsics": [[150, 0, 80], [0, 150, 60], [0, 0, 1]], "width": 160, "height": 120}
        (place / "calibration.json").write_text(json.dumps({"cameras": {"front": camera}}))
        # The pictures are of no scene, so that their depths are not compared with one.
        cfg = ImportCfg(calibration=str(place / "calibration.json"), plausibility=PlausibilityCfg(seen_share=1.0))
        worst: dict[str, float] = {}
        seconds = 0.0
        for seed in seeds:
            begun = time.perf_counter()
            recording = import_log(place / f"seed{seed}", place / "scene.xml", cfg, mapping=place / "map.toml")
            seconds += time.perf_counter() - begun
            with np.load(place / f"seed{seed}.npz") as truth:
                one = compared(recording, dict(truth))
            worst = {name: max(value, worst.get(name, 0.0)) for name, value in one.items()}
    finally:
        shutil.rmtree(place)
    return {"machine": machine(), "sets": len(seeds), **facts, "import seconds": seconds, "worst": worst}


def page(found: dict[str, Any]) -> str:
    """Return the page of results."""
    worst, facts = found["worst"], found["machine"]
    rows = {
        "data sets, episodes of each": f"{found['sets']}, 3",
        "frames of 160 x 120, colour and depth": f"{found['frames']:,}",
        "time stamps, largest difference": f"{worst['time']:.2g} s",
        "state, largest difference": f"{worst['state']:.2g} deg",
        "action, largest difference": f"{worst['action']:.2g} deg",
        "colours, largest difference of 255": f"{worst['color']:.0f}",
        "depths, largest difference": f"{1000 * worst['depth']:.2g} mm",
        "tasks that differ": f"{worst['wrong tasks']:.0f}",
        "imported in": f"{found['import seconds']:.1f} s",
    }
    table = "\n".join(f"| {name} | {value} |" for name, value in rows.items())
    return f"""# Data sets of the lerobot package, imported

Data sets with a state, an action, colours (AV1) and depths (HEVC, 12 bits, without loss) are written by the lerobot
package in its own environment. What `cw.import_log` reads of them is compared with what lerobot itself reads, number by
number and pixel by pixel. Depths that lerobot reads at the smallest distance, 10 mm, are missing ones, which an import
leaves out.

```console
$ python3.12 -m venv lerobot && lerobot/bin/pip install "lerobot[dataset]=={found["lerobot"]}"
$ python -m benchmarks.recording.import_lerobot --lerobot lerobot/bin/python
```

| | |
|---|---:|
{table}

Measured {facts["date"]} on {facts["cores"]} cores of {facts["processor"]} (lerobot {found["lerobot"]}).
Made of random numbers with seeds {SEEDS[0]} to {SEEDS[-1]}; data sets of real robots are not part of it.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lerobot", type=Path, help="Python of an environment with lerobot")
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    parser.add_argument("--table", action="store_true", help="write the page from the stored result")
    arguments = parser.parse_args()
    if not arguments.table:
        if arguments.lerobot is None:
            parser.error("--lerobot or --table is needed")
        found = measure(arguments.lerobot, tuple(arguments.seeds))
        print(json.dumps(found, indent=1))
        if tuple(arguments.seeds) != SEEDS:
            return
        write_text(DATA, json.dumps(found) + "\n")
    write_text(PAGE, page(json.loads(DATA.read_text())))


if __name__ == "__main__":
    main()
