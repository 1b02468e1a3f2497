"""What the benchmark of throughput measures with: times on the device, states to give to the bare engine, a profile."""

from __future__ import annotations

import gc
import time
from collections import Counter
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import mujoco_warp as mjw
import torch
import warp as wp

from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.graphs import Graph
from concent_warp.train.environment.physics import WarpPhysics

PARTS = ("command", "physics", "distances", "judge", "poses and pairs", "observe")
"""Parts of a step, as `Environment.parts` returns them."""
BUFFERS = {
    "nconmax": mjw.OverflowType.BROADPHASE | mjw.OverflowType.NARROWPHASE,
    "njmax": mjw.OverflowType.NEFC | mjw.OverflowType.NJMAX_NNZ,
}
"""Bits that say which buffer was too small."""


class Marks:
    """Moments on the device, or on the clock where it is the processor."""

    def __init__(self, device: str) -> None:
        """Begin without any."""
        self._cuda = device.startswith("cuda")
        self._marks: list[Any] = []

    def mark(self) -> None:
        """Note this moment."""
        if not self._cuda:
            self._marks.append(time.perf_counter())
            return
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        self._marks.append(event)

    def gaps(self) -> list[float]:
        """Return the times between the moments [ms], and forget them; this waits for the device."""
        marks, self._marks = self._marks, []
        if not self._cuda:
            return [1e3 * (b - a) for a, b in pairwise(marks)]
        torch.cuda.synchronize()
        return [a.elapsed_time(b) for a, b in pairwise(marks)]


@dataclass
class Tape:
    """States and commands at the start of the physics of some steps."""

    states: list[tuple[torch.Tensor, ...]] = field(default_factory=list)
    """Positions, velocities, commands and warm starts, shape (N, ...) each."""
    contacts: float = 0.0
    """Mean contacts of a world."""
    rows: float = 0.0
    """Mean constraint rows of a world."""
    dropping: list[str] = field(default_factory=list)
    """Buffers that were too small in some world."""


def wait(device: str) -> None:
    """Wait for the device."""
    if device.startswith("cuda"):
        torch.cuda.synchronize()
    wp.synchronize_device(device)


def environment_rounds(environment: Environment, actions: torch.Tensor, steps: int, rounds: int) -> list[float]:
    """Return the mean time of an environment step in each of some rounds [ms], by the clock."""
    times = []
    for _ in range(rounds):
        wait(str(environment.device))
        start = time.perf_counter()
        for k in range(steps):
            environment.step(actions[k % len(actions)])
        wait(str(environment.device))
        times.append(1e3 * (time.perf_counter() - start) / steps)
    return times


def stepped(environment: Environment, action: torch.Tensor, before: list[Any] | None = None) -> None:
    """Take a step part by part; each of `before` is called before the part of its place, the last after all."""
    environment.action.copy_(action)
    calls = before or [None] * (len(PARTS) + 1)
    for part, call in zip(environment.parts(), calls[:-1], strict=True):
        if call is not None:
            call()
        part()
    if calls[-1] is not None:
        calls[-1]()


def record_states(environment: Environment, actions: torch.Tensor, steps: int, *, states: bool = True) -> Tape:
    """Return what the physics of some steps starts from, unless only what its buffers held is wanted."""
    physics = warp_physics(environment)
    _, d = physics.simulator
    tape, bits, contacts, rows = Tape(), torch.zeros_like(physics.overflow), [], []

    def note() -> None:
        state = (physics.qpos, physics.qvel, physics.ctrl, physics.warmstart)
        tape.states += [tuple(value.clone() for value in state)] * states

    def look() -> None:
        bits.bitwise_or_(physics.overflow)
        contacts.append(wp.to_torch(d.nacon).float().mean() / environment.num_envs)
        rows.append(wp.to_torch(d.nefc).float().mean())

    calls = [None, note, look, None, None, None, None]
    for k in range(steps):
        stepped(environment, actions[k % len(actions)], calls)
    tape.contacts, tape.rows = (float(torch.stack(values).mean()) for values in (contacts, rows))
    seen = bits.cpu().numpy()
    tape.dropping = [name for name, mask in BUFFERS.items() if (seen & int(mask)).any()]
    return tape


def profile(environment: Environment, actions: torch.Tensor, steps: int) -> dict[str, float]:
    """Return the mean time of each part of a step [ms], one after the other as in a step."""
    marks = Marks(str(environment.device))
    for k in range(steps):
        stepped(environment, actions[k % len(actions)], [marks.mark] * (len(PARTS) + 1))
    gaps = marks.gaps()
    # Between the last mark of a step and the first of the next lies nothing but the next action.
    count = len(PARTS) + 1
    return {name: sum(gaps[i::count]) / steps for i, name in enumerate(PARTS)}


def warp_physics(environment: Environment) -> WarpPhysics:
    """Return the worlds, which must be of MuJoCo-Warp."""
    physics = environment.physics
    assert isinstance(physics, WarpPhysics)
    return physics


def bare(environment: Environment, decimation: int) -> Graph:
    """Return `mujoco_warp.step`, as many as an action has, on the environment's own model and data."""
    m, d = warp_physics(environment).simulator

    def steps() -> None:
        for _ in range(decimation):
            mjw.step(m, d)

    steps()
    graph = Graph(steps, wp.get_device(str(environment.device)), True)
    graph.launch()
    return graph


def bare_on_states(environment: Environment, tape: Tape, decimation: int) -> tuple[list[float], dict[str, float]]:
    """Return the bare engine's time from each of the recorded states [ms], and iterations of its solver."""
    physics, graph = warp_physics(environment), bare(environment, decimation)
    state = (physics.qpos, physics.qvel, physics.ctrl, physics.warmstart)
    marks, iterations = Marks(str(environment.device)), []
    niter = wp.to_torch(physics.simulator[1].solver_niter)
    for recorded in tape.states:
        for target, values in zip(state, recorded, strict=True):
            target.copy_(values)
        marks.mark()
        graph.launch()
        marks.mark()
        iterations.append(torch.stack([niter.float().mean(), niter.max().float()]))
    times = marks.gaps()[::2]
    means = torch.stack(iterations)
    return times, {"mean": float(means[:, 0].mean()), "most": float(means[:, 1].max())}


def bare_rounds(environment: Environment, decimation: int, steps: int, rounds: int) -> list[float]:
    """Return the bare engine's mean time of an action's steps, going on by itself with the commands held [ms]."""
    graph, times = bare(environment, decimation), []
    environment.reset()
    for _ in range(rounds):
        wait(str(environment.device))
        start = time.perf_counter()
        for _ in range(steps):
            graph.launch()
        wait(str(environment.device))
        times.append(1e3 * (time.perf_counter() - start) / steps)
    return times


def named_kernels(environment: Environment, actions: torch.Tensor, steps: int, most: int = 40) -> list[list[Any]]:
    """Return name, launches a step and time a step [ms] of the kernels that take most time on a CUDA device."""
    from torch.profiler import ProfilerActivity
    from torch.profiler import profile as recording

    environment_rounds(environment, actions, 4, 1)
    with recording(activities=[ProfilerActivity.CUDA]) as recorded:
        environment_rounds(environment, actions, steps, 1)
    time_of: Counter[str] = Counter()
    launches: Counter[str] = Counter()
    for event in recorded.events() or []:
        if event.device_type.name == "CUDA":
            time_of[event.name] += event.time_range.elapsed_us() / 1e3
            launches[event.name] += 1
    total = sum(time_of.values())
    rows = [[name[:120], launches[name] / steps, ms / steps] for name, ms in time_of.most_common(most)]
    return [["all", sum(launches.values()) / steps, total / steps], *rows]


def memory_used(device: str) -> int:
    """Return the memory in use on a CUDA device [byte], 0 of a processor."""
    if not device.startswith("cuda"):
        return 0
    wait(device)
    free, total = torch.cuda.mem_get_info()
    return total - free


def release() -> None:
    """Give back the memory of what is no longer referred to."""
    torch.compiler.reset()  # what was compiled refers to its environment
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
