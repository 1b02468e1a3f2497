"""The scripted expert of tasks on the table.

For an insertion: pick the object, press it beside the hole, slide until it drops in, press it in, release it. It
touches the rim, presses on it while it slides, and keeps pressing until the far wall of the hole stops the object, so
that contacts guide the object and not the arm alone. For a stack: pick the object, set it down on the other, press,
release it. Forces are exerted through the stiffness of the position control: the command lies beyond the surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np

from concent_warp.checks import Bounds, Rate
from concent_warp.scene.round_peg import RoundPegCfg
from concent_warp.scene.shape_sorter import ShapeSorterCfg
from concent_warp.scene.stacking import StackingCfg

Task = ShapeSorterCfg | RoundPegCfg | StackingCfg
"""A task that the expert can do."""
Waypoint = tuple[float, np.ndarray, np.ndarray, float, float]
"""Duration of the way to it [s], tool centre point [m], force [N], yaw [rad], opening [m]."""


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


@dataclass(frozen=True)
class Insertion:
    """Places and heights of an object and a hole."""

    start: tuple[float, float]
    """Object on the table [m]."""
    start_yaw: float
    """Its rotation about the vertical [rad]."""
    half: float
    """Half its height [m]."""
    hole: tuple[float, float]
    """Hole on the table [m]."""
    rim: float
    """Height of the rim [m]."""
    floor: float
    """Height of the floor of the hole [m]."""
    hole_yaw: float = 0.0
    """Rotation of the hole [rad]."""
    round: bool = False
    """Whether the object fits the hole in any rotation, otherwise in four."""


def plan(task: Task, cfg: ExpertCfg, start: np.ndarray, open_width: float, rng: np.random.Generator) -> Path:
    """Return the expert's path for the objects where `task` has them.

    Args:
        task: Places and sizes of the objects.
        cfg: The script.
        start: Tool centre point at time 0 [m], shape (3,).
        open_width: Control value of the open gripper [m].
        rng: Generator of the sampled offsets.
    """
    if isinstance(task, StackingCfg):
        return _follow(_stack(task, cfg, start, open_width, rng), cfg)
    if isinstance(task, RoundPegCfg):
        insertion = Insertion(
            task.peg_position, task.peg_yaw, task.peg_length / 2, task.holder_position, task.holder_height, task.floor,
            round=True,
        )  # fmt: skip
    else:
        insertion = Insertion(
            task.block_position, task.block_yaw, task.block_size / 2, task.box_position, task.box_height, task.floor,
            task.box_yaw,
        )  # fmt: skip
    return _follow(_insert(insertion, cfg, start, open_width, rng), cfg)


def _insert(
    task: Insertion, cfg: ExpertCfg, start: np.ndarray, open_width: float, rng: np.random.Generator
) -> list[Waypoint]:
    """Return the waypoints of an insertion, see `plan`."""
    block = np.array([*task.start, task.half + cfg.grip_height])
    seat = np.array([*task.hole, task.half + cfg.grip_height])
    angle = rng.uniform(0, 2 * np.pi)
    away = np.array([np.cos(angle), np.sin(angle), 0])
    aside = rng.uniform(*cfg.offset) * away
    yaw = rng.normal(0, cfg.yaw_error)
    # The gripper closes along a face normal of the block; of the two turns that fit the hole, the smaller one is taken.
    pick = _nearest_turn(task.start_yaw, 0.0)
    place = pick + (0.0 if task.round else _nearest_turn(task.hole_yaw - pick, 0.0)) + yaw
    up, rim, seated = np.array([0, 0, 1.0]), task.rim, task.floor
    free = np.zeros(3)
    lean = -cfg.press * up - 0.5 * cfg.lean * away
    over = -cfg.press * up - cfg.lean * away
    push = -cfg.push * up - cfg.lean * away
    return [
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


def _stack(
    task: StackingCfg, cfg: ExpertCfg, start: np.ndarray, open_width: float, rng: np.random.Generator
) -> list[Waypoint]:
    """Return the waypoints of a stack, see `plan`."""
    height = task.block_size / 2 + cfg.grip_height
    block, base = np.array([*task.block_position, height]), np.array([*task.base_position, height])
    pick = _nearest_turn(task.block_yaw, 0.0)
    place = pick + _nearest_turn(task.base_yaw - pick, 0.0) + rng.normal(0, cfg.yaw_error)
    up, free, top = np.array([0, 0, 1.0]), np.zeros(3), task.base_size[2]
    press = -cfg.press * up
    return [
        (0.0, start, free, 0.0, open_width),
        (0.9, block + cfg.clearance * up, free, pick, open_width),
        (0.5, block, free, pick, open_width),
        (0.3, block, free, pick, open_width),
        (0.4, block, free, pick, 0.0),
        (0.5, block + (cfg.clearance + top) * up, free, pick, 0.0),
        (0.9, base + (cfg.clearance * 0.5 + top) * up, free, place, 0.0),
        (0.5, base + top * up, free, place, 0.0),
        (0.3, base + top * up, press, place, 0.0),
        (0.3, base + top * up, press, place, 0.0),
        (0.2, base + top * up, free, place, 0.0),
        (0.3, base + top * up, free, place, open_width),
        (0.5, base + (cfg.clearance * 1.5 + top) * up, free, place, open_width),
    ]


def _follow(waypoints: list[Waypoint], cfg: ExpertCfg) -> Path:
    """Return the commands along waypoints, of which the first is the start."""
    _, start, free, _, open_width = waypoints[0]
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
