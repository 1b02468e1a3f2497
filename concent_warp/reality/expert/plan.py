"""The scripted expert: pick the block, press it beside the hole, slide until it drops in, press it in, release it.

It touches the rim, presses on the box while it slides, and keeps pressing until the far wall of the hole
stops the block, so that contacts guide the block and not the arm alone. Forces are exerted through the stiffness of the
position control: the command lies beyond the surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np

from concent_warp.checks import Bounds, Rate
from concent_warp.scene.shape_sorter import ShapeSorterCfg


@dataclass(frozen=True)
class ExpertCfg:
    """How the expert moves; offsets are sampled per demonstration."""

    rate: Rate = 50.0
    """Rate of the commands [Hz]."""
    grip_height: Annotated[float, Bounds(-1, 1)] = 0.014
    """Tool centre above the block's centre in the grasp [m]."""
    clearance: Annotated[float, Bounds(0, 1)] = 0.05
    """Height above the objects in transfer [m]."""
    offset: Annotated[tuple[float, float], Bounds(0, 1, ascending=True)] = (0.007, 0.011)
    """Distance beside the hole at which the block is set down, least and most [m]."""
    press: float = 8.0
    """Force with which the block is leaned on the rim while it slides [N]."""
    lean: float = 3.0
    """Force towards the far wall of the hole once the block is over it [N]."""
    push: float = 15.0
    """Force with which the block is pushed into the hole [N]."""
    yaw_error: float = 0.02
    """Spread of the block's rotation against the hole [rad]."""
    speed: Annotated[float, Bounds(0.01, 100)] = 1.0
    """Factor on the speed of the whole motion [-]."""


@dataclass(frozen=True)
class Path:
    """Commands along time: T samples at the expert's rate."""

    time: np.ndarray
    """Times [s], shape (T,)."""
    position: np.ndarray
    """Tool centre point [m], world frame, shape (T, 3)."""
    rotation: np.ndarray
    """Tool orientation, shape (T, 3, 3)."""
    force: np.ndarray
    """Force that the tool means to exert on its surroundings [N], world frame, shape (T, 3)."""
    opening: np.ndarray
    """Commanded opening of each finger [m], shape (T,)."""


def plan(scene: ShapeSorterCfg, cfg: ExpertCfg, start: np.ndarray, open_width: float, rng: np.random.Generator) -> Path:
    """Return the expert's path for the objects where `scene` has them.

    Args:
        scene: Places and sizes of the objects.
        cfg: The script.
        start: Tool centre point at time 0 [m], shape (3,).
        open_width: Control value of the open gripper [m].
        rng: Generator of the sampled offsets.
    """
    half = scene.block_size / 2
    block = np.array([*scene.block_position, half + cfg.grip_height])
    seat = np.array([*scene.box_position, half + cfg.grip_height])
    angle = rng.uniform(0, 2 * np.pi)
    away = np.array([np.cos(angle), np.sin(angle), 0])
    aside = rng.uniform(*cfg.offset) * away
    yaw = rng.normal(0, cfg.yaw_error)
    # The gripper closes along a face normal of the block; of the two turns that fit the hole, the smaller one is taken.
    pick = _nearest_turn(scene.block_yaw, 0.0)
    place = pick + _nearest_turn(scene.box_yaw - pick, 0.0) + yaw
    up, rim, seated = np.array([0, 0, 1.0]), scene.box_height, scene.floor
    free = np.zeros(3)
    lean = -cfg.press * up - 0.5 * cfg.lean * away
    over = -cfg.press * up - cfg.lean * away
    push = -cfg.push * up - cfg.lean * away
    waypoints: list[tuple[float, np.ndarray, np.ndarray, float, float]] = [
        # duration [s], tool centre point [m], force [N], yaw [rad], opening [m]
        (0.0, start, free, 0.0, open_width),
        (0.9, block + cfg.clearance * up, free, pick, open_width),
        (0.5, block, free, pick, open_width),
        (0.3, block, free, pick, open_width),
        (0.4, block, free, pick, 0.0),
        (0.5, block + (cfg.clearance + rim) * up, free, pick, 0.0),
        (0.9, seat + aside + (cfg.clearance * 0.5 + rim) * up, free, place, 0.0),
        (0.4, seat + aside + rim * up, free, place, 0.0),
        (0.3, seat + aside + rim * up, lean, place, 0.0),
        (0.7, seat + rim * up, lean, place, 0.0),
        (0.3, seat + rim * up, over, place, 0.0),
        (0.5, seat + seated * up, push, place, 0.0),
        (0.3, seat + seated * up, push, place, 0.0),
        (0.2, seat + seated * up, free, place, 0.0),
        (0.3, seat + seated * up, free, place, open_width),
        (0.5, seat + cfg.clearance * 1.5 * up, free, place, open_width),
    ]
    time, position, force, turn, opening = [0.0], [start], [free], [0.0], [open_width]
    for previous, (duration, goal, wrench, yaw_goal, width) in pairwise(waypoints):
        steps = max(1, round(duration / cfg.speed * cfg.rate))
        for k in range(1, steps + 1):
            share = _minimum_jerk(k / steps)
            time.append(time[-1] + 1 / cfg.rate)
            position.append(previous[1] + share * (goal - previous[1]))
            force.append(previous[2] + share * (wrench - previous[2]))
            turn.append(previous[3] + share * (yaw_goal - previous[3]))
            opening.append(previous[4] + k / steps * (width - previous[4]))
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    rotation = np.array([[[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]] for a in turn]) @ down
    return Path(np.array(time), np.array(position), rotation, np.array(force), np.array(opening))


def _minimum_jerk(share: float) -> float:
    """Return the position along a rest-to-rest minimum-jerk motion (Flash and Hogan 1985) after a share of its time."""
    return share**3 * (10 - 15 * share + 6 * share**2)


def _nearest_turn(angle: float, around: float) -> float:
    """Return the angle [rad] equal to `angle` up to quarter turns and nearest to `around`."""
    return angle - np.pi / 2 * round((angle - around) / (np.pi / 2))
