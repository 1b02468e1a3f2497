"""Motions of drives: sweeps, chirps, reversals, steps, holds, and recorded commands at another speed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from concent_warp.comparison.units import channel_text
from concent_warp.diagnosis.experiment.motions import ProposedMotion, RecordedRange, slope_turned
from concent_warp.diagnosis.experiment.payloads import loaded, on_link, payload_links
from concent_warp.effects.select import driven_joints, gripper_actuators, servo_gain
from concent_warp.recording.recording import Channel


@dataclass(frozen=True)
class Drives:
    """Position drives that may be moved, D of them, with the range of their recorded commands."""

    ids: tuple[int, ...]
    """Ids of the actuators."""
    first: np.ndarray
    """First command [rad or m], shape (D,)."""
    low: np.ndarray
    """Smallest command, shape (D,)."""
    high: np.ndarray
    """Largest command, shape (D,)."""
    speed: np.ndarray
    """Highest speed of the command [rad/s or m/s], shape (D,)."""

    @staticmethod
    def of(recorded: RecordedRange) -> Drives | None:
        """Return the position drives, grippers excepted, whose commands vary; None where there is none."""
        m = recorded.m
        gripping = set(gripper_actuators(m))
        wanted = [a for a in range(m.nu) if servo_gain(m, a) > 0 and a not in gripping and driven_joints(m, a)]
        found = []
        for a in wanted:
            rows = [d.action[m.actuator(a).name] for d in recorded.recording.demonstrations]
            low, high = min(r.value.min() for r in rows), max(r.value.max() for r in rows)
            if high - low < 1e-6:
                continue
            cfg = recorded.cfg
            speed = max(_top_speed(row, cfg.speed_window) for row in rows)
            speed = min(speed, (high - low) / cfg.min_sweep_time)
            found.append((a, float(recorded.longest.action[m.actuator(a).name].value[0]), low, high, speed))
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


def _top_speed(channel: Channel, window: float) -> float:
    """Return the highest speed of commands [1/s], averaged over a window [s]."""
    time = np.arange(channel.time[0], channel.time[-1] + window, 0.1 * window)
    row = np.maximum(np.searchsorted(channel.time, time + 1e-9, side="right") - 1, 0)
    value = channel.value[row]
    return float(np.abs(value[10:] - value[:-10]).max() / window) if len(value) > 10 else 0.0


def drive_motions(recorded: RecordedRange, tilted: bool) -> Iterator[ProposedMotion]:
    """Yield motions of drives; where the table or base may be `tilted`, with it turned too."""
    if not recorded.m.nu:
        return
    yield from _repeats(recorded, tilted)
    drives = Drives.of(recorded)
    if drives is None:
        return
    made = list(_trajectories(recorded, drives))
    yield from made
    for link in payload_links(recorded, drives.ids):
        yield from (loaded(motion, on_link(recorded, link)) for motion in made if motion.name != "steps")


def _trajectories(recorded: RecordedRange, drives: Drives) -> Iterator[ProposedMotion]:
    """Yield motions of all drives together, each in its own range, with objects out of the way."""
    m, cfg = recorded.m, recorded.cfg
    who = channel_text(m.actuator(drives.ids[0]).name) if len(drives.ids) == 1 else "all drives together"
    linear = all(m.jnt_type[j] == int(mujoco.mjtJoint.mjJNT_SLIDE) for a in drives.ids for j in driven_joints(m, a))
    unit = "m" if linear else "rad"
    middle = -1.0 + 2.0 * float(np.mean((drives.middle - drives.low) / (2 * drives.half)))
    entry = (drives.first - drives.middle) / drives.half
    quick = drives.slowest

    def ramp(a: float, b: float, duration: float) -> np.ndarray:
        """Return a straight line of commands from `a` to `b` over `duration` [s], shape (K,)."""
        return np.linspace(a, b, max(int(duration * cfg.rate), 2))

    def trajectory(parts: Sequence[np.ndarray]) -> np.ndarray:
        """Return commands (K, D): from the first ones to where the parts begin, then the parts in units of `half`."""
        begin = drives.middle + drives.half * parts[0][0]
        there = ramp(0.0, 1.0, max(quick * float(np.abs(entry - parts[0][0]).max()), 0.3))
        lead = drives.first + (begin - drives.first) * there[:, None]
        return np.concatenate([lead, drives.middle + drives.half * np.concatenate(parts)[:, None]])

    def motion(name: str, text: str, parts: Sequence[np.ndarray]) -> ProposedMotion:
        return commanded_motion(recorded, drives, name, f"{text}{_cleared_text(recorded)}", trajectory(parts))

    if len(drives.ids) == 1:
        span = f"between {drives.low[0]:.2g} and {drives.high[0]:.2g} {unit}"
        speeds = ", ".join(f"{p * drives.speed[0]:.2g}" for p in cfg.sweep_speeds) + f" {unit}/s"
    else:
        span, speeds = "over their ranges", ", ".join(f"{p:g}" for p in cfg.sweep_speeds) + " times the highest speed"
    ways = [(-1.0, 1.0), (1.0, -1.0), (-1.0, 1.0)]
    legs = [
        ramp(a, b, min(2 * quick / p, cfg.max_duration / 2)) for (a, b), p in zip(ways, cfg.sweep_speeds, strict=True)
    ]
    yield motion("sweeps", f"sweep {who} {span} at {speeds}", legs)
    reach = 0.15
    slow = 2 * reach * quick / cfg.sweep_speeds[0]
    turns = [ramp(middle + a, middle + b, slow) for a, b in ((-reach, reach), (reach, -reach))] * 2
    yield motion("slow reversals", f"move {who} to and fro slowly over {100 * reach:.0f} % of the range", turns)
    top = float(np.clip(1 / (2 * np.pi * 0.3 * quick), 1.0, 8.0))
    time = np.arange(0, 6.0, 1 / cfg.rate)
    wave = middle + 0.3 * np.sin(2 * np.pi * (0.3 * time + (top - 0.3) * time**2 / 12.0))
    yield motion("chirp", f"swing {who} over 30 % of the range with a rising frequency, 0.3 to {top:.1f} Hz", [wave])
    jumps = [np.full(int(0.6 * cfg.rate), middle + step) for step in (0.0, 0.4, -0.4, 0.2, -0.2, 0.0)]
    yield motion("steps", f"command steps of up to 40 % of the range to {who}", jumps)
    stands, here = [], -1.0
    for place in (-1.0, -0.5, 0.0, 0.5, 1.0):
        stands += [ramp(here, place, max(quick, 0.4)), np.full(int(0.7 * cfg.rate), place)]
        here = place
    yield motion("holds", f"hold {who} in five poses across the range", stands)


def _cleared_text(recorded: RecordedRange) -> str:
    """Return which objects are out of the way, in words."""
    names = [channel_text(recorded.m.body(b).name) for b in recorded.bodies]
    return f", with {' and '.join(names)} out of the way" if names else ""


def commanded_motion(
    recorded: RecordedRange, drives: Drives, name: str, text: str, command: np.ndarray
) -> ProposedMotion:
    """Return a motion from commands (K, D); the other actuators hold still."""
    cfg = recorded.cfg
    command = command[: int(cfg.max_duration * cfg.rate)]
    time = np.arange(len(command)) / cfg.rate
    action = recorded.holding(recorded.longest)
    for k, a in enumerate(drives.ids):
        action[recorded.m.actuator(a).name] = Channel(time, command[:, k])
    qpos, qvel = recorded.starts[recorded.recording.demonstrations.index(recorded.longest)]
    qpos, away = qpos.copy(), []
    for i, b in enumerate(recorded.bodies):
        qpos[int(recorded.m.jnt_qposadr[recorded.m.body_jntadr[b]])] += cfg.clearance * (1 + i)
        away.append(recorded.m.body(b).name)
    return ProposedMotion(name, text, len(command) / cfg.rate, qpos, 0 * qvel, action, tuple(away))


def _repeats(recorded: RecordedRange, tilted: bool) -> Iterator[ProposedMotion]:
    """Yield the commands of the longest demonstration at other speeds, on a turned base, or with another grip."""
    d, m, cfg = recorded.longest, recorded.m, recorded.cfg
    qpos, qvel = recorded.starts[recorded.recording.demonstrations.index(d)]
    for scale in cfg.time_scales:
        action = {name: Channel(c.time / scale, c.value) for name, c in d.action.items()}
        text = f"repeat the same commands {'faster' if scale > 1 else 'slower'}, at {scale:g} times the speed"
        yield ProposedMotion(
            "repeat at another speed", text, min(d.duration / scale, cfg.max_duration), qpos, qvel, action
        )
    duration = min(d.duration, cfg.max_duration)
    if tilted:
        text = "turn the base on which everything stands by 180 deg, so that its slope runs the other way, and repeat"
        yield ProposedMotion(
            "turned base", f"{text} the same commands", duration, qpos, qvel, d.action, change=slope_turned
        )
    hands = [m.actuator(a).name for a in gripper_actuators(m)]
    if hands and recorded.bodies:
        still: dict[str, Channel] = {**d.action, **{n: c for n, c in recorded.holding(d).items() if n in hands}}
        text = "push without a grasp: repeat the same commands with the gripper left as it is at first"
        yield ProposedMotion("push without grasp", text, duration, qpos, qvel, still)
        text = f"grip with {100 * cfg.lighter_grip:.0f} % of the commanded closing and repeat the other commands"
        yield ProposedMotion("lighter grip", text, duration, qpos, qvel, _loosened(d.action, hands, cfg.lighter_grip))


def _loosened(action: Mapping[str, Channel], hands: Sequence[str], share: float) -> dict[str, Channel]:
    """Return commands in which grippers close by a share of their recorded closing only."""
    found = dict(action)
    for name in hands:
        c = action[name]
        found[name] = replace(c, value=c.value[0] + share * (c.value - c.value[0]))
    return found
