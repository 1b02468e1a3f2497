"""Motions of drives: sweeps, chirps, reversals, steps, holds, and what was commanded at another pace."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from concent_warp.comparison.units import words
from concent_warp.diagnosis.experiment.motions import (
    EXTRA,
    LONGEST,
    RATE,
    ProposedMotion,
    RecordedRange,
    heavier,
    slope_turned,
)
from concent_warp.effects.select import driven_joints, gripper_actuators, last_links, servo_gain
from concent_warp.recording.recording import Channel

PACES = (0.1, 0.4, 1.0)
"""Speeds of the sweeps, as shares of the highest."""
FASTER, SLOWER = 1.5, 0.5
"""Paces at which recorded commands are repeated."""
WINDOW = 0.1
"""Time over which the speed of a command is taken [s]."""
QUICKEST = 0.25
"""No sweep over the whole range is quicker [s]."""
AWAY = 5.0
"""How far off the objects are put that are out of the way [m]."""
LIGHTER = 0.7
"""Share of the way from the first command of a gripper to the others that is gone when it is to press less."""


@dataclass(frozen=True)
class Drives:
    """Position drives that may be moved, D of them, with what the recording asked of them."""

    ids: tuple[int, ...]
    """Actuators."""
    first: np.ndarray
    """First command, shape (D,)."""
    low: np.ndarray
    """Smallest, shape (D,)."""
    high: np.ndarray
    """Largest, shape (D,)."""
    speed: np.ndarray
    """Highest speed [1/s], shape (D,)."""

    @staticmethod
    def of(bench: RecordedRange) -> Drives | None:
        """Return the position drives that are no grippers and were moved; None where there is none."""
        m = bench.m
        gripping = set(gripper_actuators(m))
        wanted = [a for a in range(m.nu) if servo_gain(m, a) > 0 and a not in gripping and driven_joints(m, a)]
        found = []
        for a in wanted:
            rows = [d.action[m.actuator(a).name] for d in bench.recording.demonstrations]
            low, high = min(r.value.min() for r in rows), max(r.value.max() for r in rows)
            if high - low < 1e-6:
                continue
            speed = min(max(map(_top_speed, rows)), (high - low) / QUICKEST)
            found.append((a, float(bench.longest.action[m.actuator(a).name].value[0]), low, high, speed))
        if not found:
            return None
        ids, *columns = zip(*found, strict=True)
        return Drives(ids, *(np.array(c, dtype=float) for c in columns))

    @property
    def middle(self) -> np.ndarray:
        """Middle of the range, shape (D,)."""
        return (self.low + self.high) / 2

    @property
    def half(self) -> np.ndarray:
        """Half of the range, shape (D,)."""
        return (self.high - self.low) / 2

    @property
    def slowest(self) -> float:
        """Time that the slowest of them takes over half its range at its highest speed [s]."""
        return float((self.half / self.speed).max())


def _top_speed(channel: Channel) -> float:
    """Return the highest speed of commands over `WINDOW` [1/s]."""
    time = np.arange(channel.time[0], channel.time[-1] + WINDOW, 0.1 * WINDOW)
    row = np.maximum(np.searchsorted(channel.time, time + 1e-9, side="right") - 1, 0)
    value = channel.value[row]
    return float(np.abs(value[10:] - value[:-10]).max() / WINDOW) if len(value) > 10 else 0.0


def drive_motions(bench: RecordedRange, tilted: bool) -> Iterator[ProposedMotion]:
    """Yield what drives could do; where the table or base may be `tilted`, with it turned too."""
    if not bench.m.nu:
        return
    yield from _repeats(bench, tilted)
    drives = Drives.of(bench)
    if drives is None:
        return
    made = list(_courses(bench, drives))
    yield from made
    for link in _payload_links(bench, drives):
        for motion in made:
            if motion.name != "steps":
                text = f"with {100 * EXTRA:.0f} % more mass on {words(link)}, {motion.text}"
                yield replace(motion, name=f"{motion.name} with payload", text=text, change=heavier(link))


def _payload_links(bench: RecordedRange, drives: Drives) -> list[str]:
    """Return the names of the last links that the drives carry and that something can be fastened to."""
    m = bench.m
    moved = {int(m.jnt_bodyid[j]) for a in drives.ids for j in driven_joints(m, a)}
    return [m.body(b).name for b in last_links(m) if m.body(b).name and m.body_mass[b] > 0 and _above(m, b) & moved]


def _above(m: mujoco.MjModel, body: int) -> set[int]:
    """Return a body and those that carry it."""
    found = {0}
    while body:
        found.add(body)
        body = int(m.body_parentid[body])
    return found


def _courses(bench: RecordedRange, drives: Drives) -> Iterator[ProposedMotion]:
    """Yield the motions that drives are asked for together, each in its own range, with objects out of the way."""
    m = bench.m
    who = words(m.actuator(drives.ids[0]).name) if len(drives.ids) == 1 else "all drives together"
    linear = all(m.jnt_type[j] == int(mujoco.mjtJoint.mjJNT_SLIDE) for a in drives.ids for j in driven_joints(m, a))
    unit = "m" if linear else "rad"
    middle = -1.0 + 2.0 * float(np.mean((drives.middle - drives.low) / (2 * drives.half)))
    entry = (drives.first - drives.middle) / drives.half
    quick = drives.slowest

    def course(parts: Sequence[np.ndarray]) -> np.ndarray:
        """Return commands (K, D): from the first ones to where the parts begin, then the parts in units of `half`."""
        begin = drives.middle + drives.half * parts[0][0]
        there = _ramp(0.0, 1.0, max(quick * float(np.abs(entry - parts[0][0]).max()), 0.3))
        lead = drives.first + (begin - drives.first) * there[:, None]
        return np.concatenate([lead, drives.middle + drives.half * np.concatenate(parts)[:, None]])

    def motion(name: str, text: str, parts: Sequence[np.ndarray]) -> ProposedMotion:
        return _commanded(bench, drives, name, f"{text}{_cleared_text(bench)}", course(parts))

    if len(drives.ids) == 1:
        span = f"between {drives.low[0]:.2g} and {drives.high[0]:.2g} {unit}"
        speeds = ", ".join(f"{p * drives.speed[0]:.2g}" for p in PACES) + f" {unit}/s"
    else:
        span, speeds = "over their ranges", ", ".join(f"{p:g}" for p in PACES) + " times the highest speed"
    ways = [(-1.0, 1.0), (1.0, -1.0), (-1.0, 1.0)]
    legs = [_ramp(a, b, min(2 * quick / p, LONGEST / 2)) for (a, b), p in zip(ways, PACES, strict=True)]
    yield motion("sweeps", f"sweep {who} {span} at {speeds}", legs)
    reach = 0.15
    slow = 2 * reach * quick / PACES[0]
    turns = [_ramp(middle + a, middle + b, slow) for a, b in ((-reach, reach), (reach, -reach))] * 2
    yield motion("slow reversals", f"move {who} to and fro slowly over {100 * reach:.0f} % of the range", turns)
    top = float(np.clip(1 / (2 * np.pi * 0.3 * quick), 1.0, 8.0))
    time = np.arange(0, 6.0, 1 / RATE)
    wave = middle + 0.3 * np.sin(2 * np.pi * (0.3 * time + (top - 0.3) * time**2 / 12.0))
    yield motion("chirp", f"swing {who} over 30 % of the range with a rising frequency, 0.3 to {top:.1f} Hz", [wave])
    jumps = [np.full(int(0.6 * RATE), middle + step) for step in (0.0, 0.4, -0.4, 0.2, -0.2, 0.0)]
    yield motion("steps", f"command steps of up to 40 % of the range to {who}", jumps)
    stands, here = [], -1.0
    for place in (-1.0, -0.5, 0.0, 0.5, 1.0):
        stands += [_ramp(here, place, max(quick, 0.4)), np.full(int(0.7 * RATE), place)]
        here = place
    yield motion("holds", f"hold {who} in five poses across the range", stands)


def _ramp(a: float, b: float, duration: float) -> np.ndarray:
    """Return a straight line of commands from `a` to `b` over `duration` [s], shape (K,)."""
    return np.linspace(a, b, max(int(duration * RATE), 2))


def _cleared_text(bench: RecordedRange) -> str:
    """Return which objects are put away, in words."""
    names = [words(bench.m.body(b).name) for b in bench.bodies]
    return f", with {' and '.join(names)} out of the way" if names else ""


def _commanded(bench: RecordedRange, drives: Drives, name: str, text: str, course: np.ndarray) -> ProposedMotion:
    """Return a motion from commands (K, D); the other actuators hold still."""
    course = course[: int(LONGEST * RATE)]
    time = np.arange(len(course)) / RATE
    action = bench.holding(bench.longest)
    for k, a in enumerate(drives.ids):
        action[bench.m.actuator(a).name] = Channel(time, course[:, k])
    qpos, qvel = bench.starts[bench.recording.demonstrations.index(bench.longest)]
    qpos, away = qpos.copy(), []
    for i, b in enumerate(bench.bodies):
        qpos[int(bench.m.jnt_qposadr[bench.m.body_jntadr[b]])] += AWAY * (1 + i)
        away.append(bench.m.body(b).name)
    return ProposedMotion(name, text, len(course) / RATE, qpos, 0 * qvel, action, tuple(away))


def _repeats(bench: RecordedRange, tilted: bool) -> Iterator[ProposedMotion]:
    """Yield what was commanded in the longest demonstration, done otherwise."""
    d, m = bench.longest, bench.m
    qpos, qvel = bench.starts[bench.recording.demonstrations.index(d)]
    for pace in (FASTER, SLOWER):
        action = {name: Channel(c.time / pace, c.value) for name, c in d.action.items()}
        text = f"repeat the same commands {'faster' if pace > 1 else 'slower'}, {pace:g} times the pace"
        yield ProposedMotion("repeat at another pace", text, min(d.duration / pace, LONGEST), qpos, qvel, action)
    duration = min(d.duration, LONGEST)
    if tilted:
        text = "turn the base on which everything stands by 180 deg, so that its slope runs the other way, and repeat"
        yield ProposedMotion(
            "turned base", f"{text} the same commands", duration, qpos, qvel, d.action, change=slope_turned
        )
    hands = [m.actuator(a).name for a in gripper_actuators(m)]
    if hands and bench.bodies:
        still: dict[str, Channel] = {**d.action, **{n: c for n, c in bench.holding(d).items() if n in hands}}
        text = "push without a grasp: repeat the same commands with the gripper left as it is at first"
        yield ProposedMotion("push without grasp", text, duration, qpos, qvel, still)
        text = f"grip with {100 * LIGHTER:.0f} % of the commanded closing and repeat the other commands"
        yield ProposedMotion("lighter grip", text, duration, qpos, qvel, _loosened(d.action, hands))


def _loosened(action: Mapping[str, Channel], hands: Sequence[str]) -> dict[str, Channel]:
    """Return commands in which grippers go a part of their way only."""
    found = dict(action)
    for name in hands:
        c = action[name]
        found[name] = replace(c, value=c.value[0] + LIGHTER * (c.value - c.value[0]))
    return found
