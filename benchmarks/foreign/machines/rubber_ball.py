"""A light rubber ball is dropped and bounces, or is thrown and caught; a camera reads where it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi, sqrt

from benchmarks.foreign.causes import Cause, Rng, cases
from benchmarks.foreign.contact import GRAVITY, Path, State, friction_2d, integrate
from benchmarks.foreign.log import Recorded
from benchmarks.foreign.readings import Camera

MODEL = """<mujoco model="rubber_ball">
  <option timestep="0.0005" integrator="implicitfast" cone="elliptic" density="1.2"/>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 0.1" friction="0.6"/>
    <body name="ball" pos="0 0 0.8">
      <freejoint/>
      <geom name="ball" type="sphere" size="0.06" mass="0.12" friction="0.6" priority="1" solref="-30000 -50"
        solimp="0.99 0.99 0.001" fluidshape="ellipsoid" fluidcoef="0.25 0.25 1.5 0 0"/>
    </body>
  </worldbody>
  <sensor><framepos name="ball_position" objtype="xbody" objname="ball"/></sensor>
</mujoco>
"""

MOTIONS = (
    (0.0, 0.0, 0.9, 0.0, 0.0, 0.0, 1.5),
    (0.1, -0.1, 0.6, 0.0, 0.0, 0.0, 1.3),
    (-0.8, 0.1, 1.2, 2.2, -0.3, 2.6, 0.65),
    (0.9, -0.3, 1.0, -2.9, 0.6, 2.2, 0.6),
)
"""Place [m], velocity [m/s] and time [s]: two drops, two throws."""


@dataclass(frozen=True)
class Ball:
    """Ball, floor, air and camera."""

    mass: float = 0.12
    radius: float = 0.06
    stiffness: float = 30000.0
    """Stiffness of ball and floor by the ball's mass [1/s^2]."""
    damping: float = 50.0
    """Damping of ball and floor by the ball's mass [1/s]."""
    friction: float = 0.6
    drag: float = 0.5
    """Coefficient of drag of the sphere's section."""
    wind: tuple[float, float] = (0.0, 0.0)
    spin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Angular velocity with which the ball is let go [rad/s]."""
    lift: float = 0.0
    """Force across the flight by the mass, velocity and spin (Magnus)."""
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)


VARIED = ("mass", "stiffness", "damping", "friction", "drag")


def bounce(ball: Ball, start: Sequence[float]) -> Path:
    """Return place, velocity and spin."""
    section = 0.5 * 1.2 * ball.drag * pi * ball.radius**2 / ball.mass
    r = ball.radius

    def rate(_: float, s: State) -> State:
        _, _, z, vx, vy, vz, wx, wy, wz = s
        ux, uy = vx - ball.wind[0], vy - ball.wind[1]
        speed = section * sqrt(ux * ux + uy * uy + vz * vz)
        ax = -speed * ux + ball.lift * (wy * vz - wz * vy)
        ay = -speed * uy + ball.lift * (wz * vx - wx * vz)
        az = -speed * vz + ball.lift * (wx * vy - wy * vx) - GRAVITY
        normal = 0.0
        if z < r:
            normal = max(0.0, ball.stiffness * (r - z) - ball.damping * vz)
        fx, fy = friction_2d(vx - r * wy, vy + r * wx, normal, ball.friction, ball.friction)
        turn = 2.5 / r
        return vx, vy, vz, ax + fx, ay + fy, az + normal, turn * fy, -turn * fx, 0.0

    return integrate(rate, (*start[:6], *ball.spin), start[6], step=1e-4)


def record(ball: Ball, rng: Rng) -> tuple[Sequence[Recorded], Mapping[str, float]]:
    """Return two drops and two throws."""
    camera = Camera(rate=120.0, noise=5e-4, lost=0.03, shift=ball.shift, turn=ball.turn)
    motions = []
    for start in MOTIONS:
        path = bounce(ball, start)
        place, _ = camera.read(rng, path.time, path.state[:, :3])
        motions.append(Recorded({"ball_position": place}, {}))
    return motions, {"ball_position": camera.noise}


CASES = cases(
    "rubber_ball",
    MODEL,
    Ball(),
    VARIED,
    (
        Cause("nothing", "null", noise_stated=True),
        Cause("dead_rubber", "single", (("contact_compliance",),), {"damping": 1.25}),
        Cause("ribbons", "single", (("air_drag",),), {"drag": 3.0}, noise_stated=True),
        Cause("fan", "single", (("wind",),), values={"wind": (2.2, -0.8)}),
        Cause(
            "camera_knocked",
            "single",
            (("frame_offset",),),
            values={"shift": (0.004, -0.003, 0.0), "turn": (0.012, -0.02, 0.0)},
            noise_stated=True,
        ),
        Cause("thrown_with_spin", "outside", values={"spin": (10.0, -50.0, 15.0), "lift": 0.006}),
    ),
    record,
)
