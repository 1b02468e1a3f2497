"""Printed plates in Reality: AprilTag, ArUco and ChArUco targets as textures of thin plates.

The print is on the face of a plate that looks along the z axis of its frame, its upper left corner at -x, +y. A mesh
with texture coordinates of its own carries it: MuJoCo's textures of boxes repeat, and are mirrored on some faces.
"""

from __future__ import annotations

import mujoco
import numpy as np

CELL = 48
"""Pixels of the texture along a cell of a tag."""
THICKNESS = 0.001
"""Thickness of a plate [m]."""
FACES = ((0, 1, 2), (0, 2, 3), (4, 6, 5), (4, 7, 6), (0, 5, 1), (0, 4, 5), (1, 6, 2), (1, 5, 6), (2, 7, 3), (2, 6, 7))
FACES = (*FACES, (3, 4, 0), (3, 7, 4))
"""Triangles of a plate, those with the print first."""


def tag_print(dictionary: str, number: int) -> tuple[np.ndarray, float]:
    """Return the picture of a tag with a white edge one cell wide, uint8, shape (h, h), and its width in tag sizes [-].

    Args:
        dictionary: Name in `cv2.aruco`, such as DICT_APRILTAG_36h11.
        number: Number of the tag.
    """
    import cv2

    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    cells = family.markerSize + 2
    tag = cv2.aruco.generateImageMarker(family, number, cells * CELL)
    return np.pad(tag, CELL, constant_values=255), (cells + 2) / cells


def charuco_print(dictionary: str, columns: int, rows: int, share: float) -> tuple[np.ndarray, float]:
    """Return the picture of a ChArUco board, uint8, shape (h, w), and the height over the width of the board [-].

    Args:
        dictionary: Name in `cv2.aruco`.
        columns: Squares along x.
        rows: Squares along y.
        share: Size of a tag over that of a square [-].
    """
    import cv2

    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    board = cv2.aruco.CharucoBoard((columns, rows), 1.0, share, family)
    square = 2 * CELL
    return board.generateImage((columns * square, rows * square), marginSize=0), rows / columns


def add_plate(
    spec: mujoco.MjSpec, body: str, name: str, pose: np.ndarray, picture: np.ndarray, size: tuple[float, float]
) -> None:
    """Add a thin plate with a picture on it to a body.

    Args:
        spec: The world; it is changed.
        body: Body that carries the plate, or world.
        name: Name of the geom.
        pose: Pose of the middle of the print in the frame of the body, shape (4, 4); the print looks along z.
        picture: Grey values, uint8, shape (h, w); its first row is at +y.
        size: Width and height of the plate [m].
    """
    height, width = picture.shape
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height, nchannel=3)
    texture.data = np.ascontiguousarray(np.repeat(picture[:, :, None], 3, axis=2)).tobytes()
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(size) / 2
    mesh = spec.add_mesh(name=name)
    mesh.uservert = np.concatenate(
        [np.c_[corners, np.zeros(4)], np.c_[corners, np.full(4, -THICKNESS)]]
    ).ravel()  # the print lies in the plane z = 0
    mesh.userface = np.array(FACES).ravel()
    # The first row of a texture is at v = 0; the sides of the plate take the white of its corner.
    mesh.usertexcoord = np.array([[0, 1], [1, 1], [1, 0], [0, 0], [0.005, 0.005]], dtype=float).ravel()
    mesh.userfacetexcoord = np.array([*FACES[:2], *[(4, 4, 4)] * (len(FACES) - 2)]).ravel()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    material = spec.add_material(name=name, specular=0.05)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(pose[:3, :3]).ravel())
    carrier = spec.worldbody if body == "world" else spec.body(body)
    carrier.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=name,
        pos=list(pose[:3, 3]),
        quat=list(quaternion),
        contype=0,
        conaffinity=0,
        mass=0.0,
    )
