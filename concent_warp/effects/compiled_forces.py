"""Force models as machine code: functions that act on MuJoCo's arrays, each on one element by a row of numbers.

C MuJoCo calls nothing of ours between the parts of a step, so a force model has to act between steps. In Python that
costs more than the step of a small robot. Numba compiles the same lines in some seconds, once for an
installation; where it is not installed, they run as they stand.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import mujoco
import numpy as np

try:
    from numba import njit, types
    from numba.extending import register_jitable

    mj_step = types.ExternalFunction("mj_step", types.void(types.intp, types.intp))
except ImportError:  # hosts without it simulate the same in Python
    njit = register_jitable = None

F = TypeVar("F", bound=Callable[..., Any])


class StepState(NamedTuple):
    """MuJoCo's own arrays that force models read and write, see `mujoco.MjData` and `mujoco.MjModel`."""

    ctrl: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    qacc: np.ndarray
    userdata: np.ndarray
    qfrc_actuator: np.ndarray
    qfrc_bias: np.ndarray
    qfrc_applied: np.ndarray
    xfrc_applied: np.ndarray
    xipos: np.ndarray
    geom_xpos: np.ndarray
    geom_xmat: np.ndarray
    sensordata: np.ndarray
    dof_frictionloss: np.ndarray
    dof_armature: np.ndarray
    actuator_gainprm: np.ndarray
    actuator_biasprm: np.ndarray
    actuator_forcerange: np.ndarray
    site_pos: np.ndarray

    @classmethod
    def of(cls, m: mujoco.MjModel, d: mujoco.MjData) -> StepState:
        """Return those of a model and its data."""
        return cls(*(getattr(d if hasattr(d, name) else m, name) for name in cls._fields))


FREE = 1e9
"""Limit of an actuator's force that is none [N m or N]."""
WIDTH = 28
"""Most numbers of a row."""

Row = tuple[list[int], list[float]]
"""What a force on one element needs: indices, and numbers."""
Numbers = Sequence[Any] | np.ndarray
"""A row in Python, or in the table of a compiled simulation."""


def inlined(function: F) -> F:
    """Let compiled code call a function; called from Python, it stays Python."""
    return function if register_jitable is None else register_jitable(function)


def compiled(function: F) -> F:
    """Let Numba compile a function when it is first called, and keep the machine code.

    It is kept as long as this file stays as it is, so all that a compiled function calls is in this file.
    """
    if njit is None:
        return function
    try:
        return njit(cache=True)(function)  # pyright: ignore[reportReturnType]
    except RuntimeError:  # no folder to keep it in
        return njit(function)  # pyright: ignore[reportReturnType]


@cache
def can_compile() -> bool:
    """Return whether `step` can be compiled: Numba is installed, and MuJoCo's library is where it should be."""
    if njit is None:
        return False
    import llvmlite.binding

    folder = Path(mujoco.__file__).parent
    libraries = [p for name in ("libmujoco.so*", "libmujoco*.dylib", "mujoco.dll") for p in sorted(folder.glob(name))]
    if not libraries:
        return False
    llvmlite.binding.load_library_permanently(str(libraries[0]))
    return llvmlite.binding.address_of_symbol("mj_step") is not None


@inlined
def add_stribeck(begun: bool, whole: Numbers, real: Numbers, state: StepState) -> None:  # noqa: ARG001
    """Add to the friction loss of whole[0]; numbers: extra, half a step [s], speed."""
    dof = whole[0]
    ratio = (state.qvel[dof] + real[1] * state.qacc[dof]) / real[2]
    state.dof_frictionloss[dof] += real[0] * math.exp(-ratio * ratio)


@inlined
def add_load(begun: bool, whole: Numbers, real: Numbers, state: StepState) -> None:  # noqa: ARG001
    """Add to the friction loss of whole[0]; the number is half the coefficient."""
    dof = whole[0]
    state.dof_frictionloss[dof] += real[0] * (abs(state.qfrc_actuator[dof]) + abs(state.qfrc_bias[dof]))


@inlined
def through_play(real: Numbers, error: float, speed: float, begun: bool, ahead: Any) -> tuple[float, float]:
    """Return what a play changes of the force on the joint [N m or N], and the rotor's lead after the step.

    Args:
        real: See `Gear.numbers`.
        error: Of the link, as a position.
        speed: Of the link.
        begun: Whether this is not the first step.
        ahead: The rotor's lead, unless it is.
    """
    gear, kp, kv, weakest, strongest, half, fading, timestep = (
        real[0], real[1], real[2], real[5], real[6], real[9], real[10], real[11]
    )  # fmt: skip
    force = kp * error - kv * speed
    if not begun:
        ahead = min(max(force / kp, -half), half)
    alone = error + (ahead - error) * fading - speed * timestep
    after = min(max(alone, -half), half)
    share = 0.0 if alone == after else (alone - after) / (alone - ahead)
    pressed = share * (kp * (error - after) - kv * speed)
    change = min(max(pressed, weakest), strongest) - min(max(force, weakest), strongest)
    return gear * change, after


@inlined
def pass_play(begun: bool, whole: Numbers, real: Numbers, state: StepState) -> None:
    """Act on a joint; indices: actuator, of the joint in positions and velocities, slot in the user data."""
    actuator, place, dof, slot = whole[0], whole[1], whole[2], whole[3]
    error = min(max(state.ctrl[actuator], real[3]), real[4]) + real[7] + real[8] * state.qpos[place]
    change, after = through_play(real, error, real[0] * state.qvel[dof], begun, state.userdata[slot])
    state.userdata[slot] = after
    state.qfrc_applied[dof] += change


@inlined
def drive_by_spring(begun: bool, whole: Numbers, real: Numbers, state: StepState) -> None:
    """Act on a joint, see `ElasticGearForce`; before the first step the twist is at rest.

    Args:
        begun: Whether this is not the first step.
        whole: Actuator, site, place of the joint in positions and in velocities, first of the user data.
        real: See `ElasticGear.numbers`.
        state: MuJoCo's arrays.
    """
    actuator, site, place, dof, slot = whole[0], whole[1], whole[2], whole[3], whole[4]
    gear, weakest, strongest, gain = real[0], real[3], real[4], real[5]
    kp, kv, stiffness, damping = real[9], real[10], real[11], real[12]
    inertia, implicit, spring, slowed, timestep = real[13], real[14], real[15], real[16], real[17]
    kept, velocity = state.userdata, state.qvel[dof]
    command = min(max(state.ctrl[actuator], real[1]), real[2])
    free = gain * command + real[6] + real[7] * gear * state.qpos[place] + real[8] * gear * velocity
    if begun:
        rate = kept[slot + 1] + kept[slot + 2] - kept[slot + 3] * velocity
        twist = kept[slot] + timestep * rate
    else:
        carried = stiffness * free / (kp + stiffness)
        twist, rate = gear * min(max(carried, weakest), strongest) / stiffness, 0.0
    torque = stiffness * twist + damping * rate
    back = kp * twist + kv * rate
    total = inertia + spring + slowed
    push = gear * free - back - torque
    force = free - (back + slowed * push / total) / gear  # its mean over the step
    servo = min(max(force, weakest), strongest)
    limited = servo != force
    if limited:
        total, push = inertia + spring, gear * servo - torque
    share = spring / total
    follow = (inertia + (0.0 if limited else implicit)) / total
    kept[slot], kept[slot + 1] = twist, rate
    kept[slot + 2], kept[slot + 3] = push * timestep / total + follow * velocity, follow
    state.site_pos[site, 0], state.site_pos[site, 1], state.site_pos[site, 2] = twist, rate, servo
    state.qfrc_applied[dof] += torque + share * (push - (0.0 if limited else gear * free))
    state.dof_armature[dof] = share * inertia
    # A limited servo's force is a part of the applied one.
    state.actuator_gainprm[actuator, 0] = 0.0 if limited else real[18]
    for i in range(3):
        state.actuator_biasprm[actuator, i] = 0.0 if limited else real[19 + i]
    state.actuator_forcerange[actuator, 0], state.actuator_forcerange[actuator, 1] = -FREE, FREE


@inlined
def push_by_bump(begun: bool, whole: Numbers, real: Numbers, state: StepState) -> None:  # noqa: ARG001
    """Act on a degree of freedom; indices: it, what the force depends on, whether that is a velocity."""
    of = state.qvel[whole[1]] if whole[2] else state.qpos[whole[1]]
    x = (of - real[0]) * real[1]
    state.qfrc_applied[whole[0]] += real[2] * math.exp(-0.5 * x * x)


@inlined
def pull_to_plane(begun: bool, whole: Numbers, real: Numbers, state: StepState) -> None:
    """Act on a body at those points of a geom that lie within a gap of a plane, see `AdhesionForce`.

    Before the first step nothing is known of where geoms are, and nothing acts.

    Args:
        begun: Whether this is not the first step.
        whole: Geom, plane, body, number of points.
        real: Strength, gap, radius and reach of the geom, points in its frame.
        state: MuJoCo's arrays.
    """
    if not begun:
        return
    centre, turn, middle = state.geom_xpos[whole[0]], state.geom_xmat[whole[0]], state.xipos[whole[2]]
    place, axes = state.geom_xpos[whole[1]], state.geom_xmat[whole[1]]
    nx, ny, nz = axes[2], axes[5], axes[8]
    cx, cy, cz = centre[0], centre[1], centre[2]
    strength, gap, radius = real[0], real[1], real[2]
    height = cx * nx + cy * ny + cz * nz - (place[0] * nx + place[1] * ny + place[2] * nz)
    if height > real[3]:
        return
    ax = nx * turn[0] + ny * turn[3] + nz * turn[6]
    ay = nx * turn[1] + ny * turn[4] + nz * turn[7]
    az = nx * turn[2] + ny * turn[5] + nz * turn[8]
    below, count, sx, sy, sz = gap + radius - height, 0, 0.0, 0.0, 0.0
    for i in range(whole[3]):
        px, py, pz = real[4 + 3 * i], real[5 + 3 * i], real[6 + 3 * i]
        if px * ax + py * ay + pz * az < below:
            count, sx, sy, sz = count + 1, sx + px, sy + py, sz + pz
    if not count:
        return
    # All pull alike, so that their forces act as one at the sum of their arms.
    x = turn[0] * sx + turn[1] * sy + turn[2] * sz + count * (cx - radius * nx - middle[0])
    y = turn[3] * sx + turn[4] * sy + turn[5] * sz + count * (cy - radius * ny - middle[1])
    z = turn[6] * sx + turn[7] * sy + turn[8] * sz + count * (cz - radius * nz - middle[2])
    fx, fy, fz = -strength * nx, -strength * ny, -strength * nz
    applied = state.xfrc_applied[whole[2]]
    applied[0] += count * fx
    applied[1] += count * fy
    applied[2] += count * fz
    applied[3] += y * fz - z * fy
    applied[4] += z * fx - x * fz
    applied[5] += x * fy - y * fx


FIELD, BRAKE, DRAG, TURNING = range(4)
"""Ways of a force on a body, see `concent_warp.effects.unknown_force.Way`."""


@inlined
def push_body_by_bump(begun: bool, whole: Numbers, real: Numbers, state: StepState) -> None:  # noqa: ARG001
    """Act on a free body by one basis function, see `UnknownBodyForce`.

    Args:
        begun: Whether this is not the first step.
        whole: Body, its place in positions and in velocities, way.
        real: Center (3), one over the width, size (3), speed below which a resistance fades out.
        state: MuJoCo's arrays.
    """
    body, place, dof, way = whole[0], whole[1], whole[2], whole[3]
    first = dof + 3 if way == TURNING else dof
    vx, vy, vz = state.qvel[first], state.qvel[first + 1], state.qvel[first + 2]
    speed = math.sqrt(vx * vx + vy * vy + vz * vz)
    if way in (FIELD, BRAKE):
        x, y, z = state.qpos[place] - real[0], state.qpos[place + 1] - real[1], state.qpos[place + 2] - real[2]
        square = (x * x + y * y + z * z) * real[3] * real[3]
    else:
        off = (speed - real[0]) * real[3]
        square = off * off
    bump = math.exp(-0.5 * square)
    force = state.xfrc_applied[body]
    if way == FIELD:
        force[0] += bump * real[4]
        force[1] += bump * real[5]
        force[2] += bump * real[6]
        return
    size = bump * real[4] / math.sqrt(speed * speed + real[7] * real[7])
    if way == TURNING:
        state.qfrc_applied[first] -= size * vx
        state.qfrc_applied[first + 1] -= size * vy
        state.qfrc_applied[first + 2] -= size * vz
    else:
        force[0] -= size * vx
        force[1] -= size * vy
        force[2] -= size * vz


FORCES = (add_stribeck, add_load, pass_play, drive_by_spring, push_by_bump, pull_to_plane, push_body_by_bump)
"""What may act, by the numbers that `act` knows them by."""


@inlined
def act(begun: bool, whole: np.ndarray, real: np.ndarray, state: StepState) -> None:
    """Let the rows of a table act on the coming step, in their order.

    Args:
        begun: Whether this is not the first step.
        whole: Which of `FORCES`, and indices, shape (n, 6) int.
        real: Numbers, shape (n, WIDTH).
        state: MuJoCo's arrays.
    """
    for n in range(len(whole)):
        kind, indices, numbers = whole[n, 0], whole[n, 1:], real[n]
        if kind == 0:
            add_stribeck(begun, indices, numbers, state)
        elif kind == 1:
            add_load(begun, indices, numbers, state)
        elif kind == 2:
            pass_play(begun, indices, numbers, state)
        elif kind == 3:
            drive_by_spring(begun, indices, numbers, state)
        elif kind == 4:
            push_by_bump(begun, indices, numbers, state)
        elif kind == 5:
            pull_to_plane(begun, indices, numbers, state)
        else:
            push_body_by_bump(begun, indices, numbers, state)


@compiled
def step(
    model: int,
    data: int,
    state: StepState,
    ctrl: np.ndarray,
    row_of: np.ndarray,
    whole: np.ndarray,
    real: np.ndarray,
    qpos: np.ndarray,
    qvel: np.ndarray,
    sensordata: np.ndarray,
) -> None:
    """Step, see `step_compiled`; model and data are addresses."""
    loss = state.dof_frictionloss.copy()
    for k in range(len(row_of)):
        if k < len(ctrl):
            state.ctrl[:] = ctrl[k]
        state.qfrc_applied[:] = 0.0
        state.xfrc_applied[:] = 0.0
        state.dof_frictionloss[:] = loss
        act(k > 0, whole, real, state)
        row = row_of[k]
        if row >= 0:
            qpos[row] = state.qpos
            qvel[row] = state.qvel
        mj_step(model, data)
        if row >= 0:
            sensordata[row] = state.sensordata
