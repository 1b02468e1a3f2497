"""Options that commands share, so that they have one name and one meaning."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from concent_warp.simulate.select import EngineName

OutPath = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
"""``-o/--out``: the file or folder that a command writes."""
OptionalOutPath = Annotated[Path | None, tyro.conf.arg(aliases=["-o"])]
"""The same where nothing is written, or a default name is taken, without it."""
EngineOption = Annotated[
    EngineName,
    tyro.conf.arg(
        help='What simulates the model: "mujoco" (C MuJoCo, on the CPU), "warp" (MuJoCo-Warp), or "auto", '
        "MuJoCo-Warp where there is a CUDA device."
    ),
]
"""``--engine``: what simulates a model."""
DeviceOption = Annotated[
    str | None,
    tyro.conf.arg(
        help='Where networks and parallel worlds are computed: "cpu" or "cuda:0"; the first CUDA device by default '
        "where there is one."
    ),
]
"""``--device``: where torch and Warp compute."""
NoiseOption = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        metavar="CHANNEL=NUMBER",
        help="Standard deviation of the measurement noise of channels, such as angle=0.001 or '*_position=2e-4', in "
        "their units; by default as the recording states it, else estimated from the readings.",
    ),
]
"""``--noise``: what a user knows about the instruments."""
