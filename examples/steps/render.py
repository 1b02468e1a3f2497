"""Render episodes of a policy as images in a data set for policies that act on images.

python examples/steps/render.py [--episodes 5] [--size 128] [--format lerobot] [--out runs/dataset]
"""

from pathlib import Path
from typing import Literal

import tyro

import concent_warp as cw


def main(
    out: Path = Path("runs/dataset"),
    episodes: int = 5,
    size: int = 128,
    format: Literal["lerobot", "robomimic"] = "lerobot",
) -> None:
    """Render successful episodes of the policy that comes with the package, from a base and a wrist camera."""
    cfg = cw.RenderCfg(episodes=episodes, size=size)
    dataset = cw.render(cw.load_policy("shape_sorter"), out, cfg, format=format, overwrite=True)
    print(f"{dataset.episodes} episodes; {out}")


if __name__ == "__main__":
    tyro.cli(main)
