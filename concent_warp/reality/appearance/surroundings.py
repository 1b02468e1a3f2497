"""Appearance of the surroundings in Reality: wooden table, floor and walls, with other lights and colours than nominal.

Like the pattern on the objects, all of it is for cameras alone; the physics never sees it.
"""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.ndimage import gaussian_filter

from concent_warp.reality.appearance.speckle import dress

TABLE = "table"
"""Name of the geom that gets a wooden texture."""
ROOM_HALF_WIDTH = 1.6
"""Half width of the room [m]."""
FLOOR_HEIGHT = -0.75
"""Height of the floor below the table's top [m]."""
TEXELS = 256
"""Pixels along an edge of a texture."""
ROBOT_TINT = np.array([1.0, 0.93, 0.82])
"""Factor on the colours of the robot: a yellowish tint."""
SUN = {"pos": [0.15, 0.75, 1.7], "dir": [0.12, -0.38, -1.0], "diffuse": [0.85, 0.78, 0.66], "castshadow": True}
LAMP = {"pos": [1.3, -0.9, 1.2], "dir": [-0.7, 0.6, -0.8], "diffuse": [0.22, 0.25, 0.32], "castshadow": False}
"""Lights that replace the nominal ones."""


def furnish(world: mujoco.MjSpec, bodies: tuple[str, ...], *, there: bool = True) -> mujoco.MjSpec:
    """Return a copy of Reality with textures, lights and room, its objects with speckle patterns.

    Args:
        world: Reality.
        bodies: Objects.
        there: Whether the objects are visible.
    """
    spec = dress(world, bodies if there else ())
    rng = np.random.default_rng(1)
    if not there:
        for name in bodies:
            for geom in list(spec.body(name).geoms):
                geom.rgba, geom.group = [0, 0, 0, 0], mujoco.mjNGROUP - 1
    for geom in spec.geoms:
        if geom.parent.name in (*bodies, "world"):
            continue
        geom.rgba[:3] = np.array(geom.rgba[:3]) * ROBOT_TINT
    table = spec.geom(TABLE)
    if table is not None:
        _cover(spec, table, "wood", _wood(rng), (3, 3))
    light(spec)
    _add_room(spec, rng)
    return spec


def light(spec: mujoco.MjSpec) -> None:
    """Replace a world's lights by `SUN` and `LAMP`."""
    for there in list(spec.lights):
        spec.delete(there)
    for lamp in (SUN, LAMP):
        spec.worldbody.add_light(**lamp, ambient=[0.05, 0.05, 0.06], specular=[0.2, 0.2, 0.2])
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.16, 0.17, 0.2], [0.12, 0.12, 0.12]


def _add_room(spec: mujoco.MjSpec, rng: np.random.Generator) -> None:
    """Add a floor and two walls that nothing touches."""
    height, thin = 1.2, 0.01
    half, floor = ROOM_HALF_WIDTH, FLOOR_HEIGHT
    plates = {
        "floor": ([0, 0, floor], [2 * half, 2 * half, thin], _tiles(rng), (6, 6)),
        "back": (
            [-0.55 * ROOM_HALF_WIDTH, 0, FLOOR_HEIGHT + height],
            [thin, 2 * ROOM_HALF_WIDTH, height],
            _plaster(rng),
            (1, 1),
        ),
        "side": (
            [0, 0.6 * ROOM_HALF_WIDTH, FLOOR_HEIGHT + height],
            [2 * ROOM_HALF_WIDTH, thin, height],
            _plaster(rng),
            (2, 1),
        ),
    }
    for name, (position, size, texture, repeat) in plates.items():
        geom = spec.worldbody.add_geom(
            name=f"room_{name}", type=mujoco.mjtGeom.mjGEOM_BOX, pos=position, size=size, contype=0, conaffinity=0
        )
        _cover(spec, geom, f"room_{name}", texture, repeat)


def _cover(
    spec: mujoco.MjSpec, geom: mujoco.MjsGeom, name: str, texture: np.ndarray, repeat: tuple[float, float]
) -> None:
    """Lay a texture, shape (n, n, 3) uint8, on a geom."""
    made = spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=texture.shape[1], height=texture.shape[0], nchannel=3
    )
    made.data = texture.tobytes()
    material = spec.add_material(name=name, rgba=[1, 1, 1, 1], specular=0.1, texrepeat=list(repeat))
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    geom.rgba, geom.material = [1, 1, 1, 1], name


def _wood(rng: np.random.Generator) -> np.ndarray:
    """Return boards with a grain."""
    boards = 4
    grain = gaussian_filter(rng.normal(size=(TEXELS, TEXELS)), (1.0, 24.0), mode="wrap")
    board = np.repeat(rng.normal(0, 0.06, boards), TEXELS // boards)[:, None]
    seam = (np.arange(TEXELS) % (TEXELS // boards) < 3)[:, None] * 0.25
    return _painted(0.72 + 0.09 * grain / grain.std() + board - seam, (0.82, 0.60, 0.40))


def _tiles(rng: np.random.Generator) -> np.ndarray:
    """Return grey tiles with light joints."""
    cell = TEXELS // 4
    joint = (np.arange(TEXELS) % cell < 4)[:, None] | (np.arange(TEXELS) % cell < 4)[None]
    spots = gaussian_filter(rng.normal(size=(TEXELS, TEXELS)), 2.0, mode="wrap")
    return _painted(0.45 + 0.05 * spots / spots.std() + 0.3 * joint, (0.55, 0.60, 0.62))


def _plaster(rng: np.random.Generator) -> np.ndarray:
    """Return a wall that is darker below, with faint stains and a board fixed to it."""
    stains = gaussian_filter(rng.normal(size=(TEXELS, TEXELS)), 12.0, mode="wrap")
    level = 0.75 + 0.05 * stains / stains.std() + np.linspace(-0.15, 0.1, TEXELS)[:, None]
    level[70:130, 90:170] -= 0.35
    return _painted(level, (0.80, 0.84, 0.78))


def _painted(level: np.ndarray, colour: tuple[float, float, float]) -> np.ndarray:
    """Return a texture, uint8, of a brightness (n, m) in one colour."""
    return np.clip(255 * level[..., None] * np.array(colour), 0, 255).astype(np.uint8)
