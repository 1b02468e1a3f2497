"""Write a data set of rendered episodes and read every frame of it with the lerobot package, in another environment.

    python -m benchmarks.render.dataset_lerobot --lerobot /path/to/its/python --out lerobot.jsonl

lerobot pins older versions of torch and NumPy, so that it cannot share this project's environment; make one with
`python -m venv lerobot && lerobot/bin/pip install lerobot==0.4.4`. A line of JSON is appended to --out.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

from benchmarks.pages import machine
from concent_warp.cli.entry import main as concent


def written(folder: Path, arguments: argparse.Namespace) -> dict[str, float]:
    """Write the data set and return how long it took [s], its size and the memory taken [MB]."""
    begun = time.perf_counter()
    options = ["--episodes", str(arguments.episodes), "--size", str(arguments.size), "--device", arguments.device]
    if concent(["render", "--pretrained", "--keep", "all", "--out", str(folder), *options]) != 0:
        raise SystemExit("the data set could not be written")
    seconds = time.perf_counter() - begun
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return {"seconds": seconds, "megabytes": size / 1e6, "peak memory": memory}


def read(folder: Path, python: Path) -> dict[str, object]:
    """Return what lerobot says of the data set."""
    script = Path(__file__).with_name("dataset_lerobot_load.py")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    environment |= {"HF_HUB_OFFLINE": "1", "HF_HOME": str(folder / ".cache")}
    done = subprocess.run(
        [str(python), str(script), str(folder)],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
        timeout=600,
    )
    if done.returncode != 0:
        raise SystemExit(f"lerobot could not read the data set:\n{done.stderr}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lerobot", type=Path, required=True, help="Python of an environment with lerobot")
    parser.add_argument("--episodes", type=int, default=18)
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path("lerobot.jsonl"))
    arguments = parser.parse_args()
    place = Path(tempfile.mkdtemp())
    try:
        found = {"machine": machine(arguments.device), "size": arguments.size}
        found["written"] = written(place / "data", arguments)
        found["read"] = read(place / "data", arguments.lerobot)
    finally:
        shutil.rmtree(place)
    with arguments.out.open("a") as file:
        file.write(json.dumps(found) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
