"""A tiny LeRobot data set whose best policy is known, and settings of a policy that is learned in seconds.

The image is dark but for a bright bar, whose column is the goal: the first action goes to it. In half of the episodes
the second action is +1, in the others -1, for no visible reason: its distribution has two modes. An instruction, "up"
or "down", gives the sign of the third.
"""

from pathlib import Path

import numpy as np

from concent_warp.render.dataset.layout import EpisodeLayout
from concent_warp.render.dataset.lerobot import LeRobotWriter
from concent_warp.train.distil.cfg import AugmentCfg
from concent_warp.train.flow.cfg import FlowDataCfg, FlowPolicyCfg, SmallBackboneCfg, TrainFlowCfg

SIZE, LENGTH, RATE = 16, 6, 10
UP, DOWN = "push it up", "push it down"
SIZES = FlowPolicyCfg(
    size=16, chunk=4, execute=2, width=32, causal=False, layers=2, heads=2,
    small=SmallBackboneCfg(channels=(8, 16, 32), text_layers=1, fusion_layers=1, text_bytes=40),
)  # fmt: skip
TINY = TrainFlowCfg(
    steps=210, batch=32, learning_rate=5e-3, warm_up=20, ema=0.98, validate=70, validation_samples=64, policy=SIZES,
    blank_state=0.0, data=FlowDataCfg(validation=0.2),
    augment=AugmentCfg(
        shift=0, brightness=0.02, contrast=0.02, balance=0.02, gamma=(1, 1), vignette=0, noise=0, blur=0,
    ),
)  # fmt: skip


def image(goal: float) -> np.ndarray:
    """Return an image with a bright bar at a goal in -1..1."""
    found = np.full((SIZE, SIZE, 3), 20, dtype=np.uint8)
    column = round((goal + 1) / 2 * (SIZE - 2))
    found[:, column : column + 2] = 230
    return found


def write_dataset(folder: Path, episodes: int = 40, cameras: tuple[str, ...] = ("front",)) -> Path:
    """Write the data set."""
    layout = EpisodeLayout(RATE, cameras, (SIZE, SIZE), ("slider",), ("goal", "side", "lift"))
    writer, generator = LeRobotWriter(folder, layout), np.random.default_rng(0)
    for key in range(episodes):
        goal, side, up = -0.9 + 0.2 * (key // 4 % 10), 1.0 - 2.0 * (key % 2), key // 2 % 2
        episode = writer.begin(key, UP if up else DOWN)
        for _ in range(LENGTH):
            action = np.array([goal, side, 1.0 if up else -1.0])
            episode.add({name: image(goal) for name in cameras}, generator.normal(size=1), action)
        episode.save()
    writer.finish()
    return folder
