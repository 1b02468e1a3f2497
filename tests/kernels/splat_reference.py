"""Splats rendered in float64, one Gaussian after the other over whole images: no tiles, no lists, SciPy's harmonics."""

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import factorial, lpmv

FLIP = np.diag([1.0, -1.0, -1.0])


def rotation(quaternion):
    return Rotation.from_quat(np.asarray(quaternion), scalar_first=True).as_matrix()


def colours(harmonics, direction):
    """Real spherical harmonics with the Condon-Shortley phase, plus 0.5, shape (N, 3)."""
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    total, k = np.full((len(direction), 3), 0.5), 0
    for degree in range(4):
        for order in range(-degree, degree + 1):
            if k == harmonics.shape[1]:
                return np.maximum(total, 0)
            m = abs(order)
            size = np.sqrt((2 * degree + 1) / (4 * np.pi) * factorial(degree - m) / factorial(degree + m))
            value = size * lpmv(m, degree, np.clip(direction[:, 2], -1, 1))
            if order:
                value = np.sqrt(2) * value * (np.cos(m * azimuth) if order > 0 else np.sin(m * azimuth))
            total += value[:, None] * harmonics[:, k]
            k += 1
    return np.maximum(total, 0)


def render(
    splats, pose, camera, pinhole, width, height, *, hidden=None, margin=0.0, antialias=True, light=None, ground=0.0
):
    """Return rgb (H, W, 3), alpha (H, W) and depth (H, W) of one camera.

    Args:
        splats: means, quats, scales, opacities, harmonics, owner.
        pose: poses of the objects, shape (O, 7).
        camera: its pose, shape (7,).
        pinhole: fx, fy, cx, cy.
        width: of the image.
        height: of the image.
        hidden: depth beyond which nothing shows, shape (H, W).
        margin: how far beyond something does.
        antialias: as the kernels take it.
        light: direction along which the splats are flattened onto the ground, shape (3,); colours then mean nothing.
        ground: its height.
    """
    means, quats, scales, opacities, harmonics, owner = splats
    fx, fy, cx, cy = pinhole
    to_camera = FLIP @ rotation(camera[3:]).T
    turn = to_camera @ rotation(pose[owner, 3:])
    world = np.einsum("nij,nj->ni", rotation(pose[owner, 3:]), means) + pose[owner, :3]
    if light is not None:
        world = world - light * ((world[:, 2:] - ground) / light[2])
        turn = to_camera @ (np.eye(3) - np.outer(light / light[2], [0, 0, 1])) @ rotation(pose[owner, 3:])
    seen = (world - camera[:3]) @ to_camera.T
    x, y, z = seen.T
    direction = np.einsum("nji,nj->ni", turn, seen / np.linalg.norm(seen, axis=1, keepdims=True))
    colour = colours(harmonics, direction)
    root = turn @ rotation(quats) * scales[:, None, :]
    row, column = np.mgrid[:height, :width].astype(float)
    light, through, distance = np.zeros((height, width, 3)), np.ones((height, width)), np.zeros((height, width))
    limit = np.full((height, width), np.inf) if hidden is None else np.where(hidden > 0, hidden + margin, np.inf)
    for i in np.argsort(z, kind="stable"):
        if z[i] < 0.01:
            continue
        u = np.clip(x[i] / z[i], -cx / fx - 0.15 * width / fx, (width - cx) / fx + 0.15 * width / fx)
        v = np.clip(y[i] / z[i], -cy / fy - 0.15 * height / fy, (height - cy) / fy + 0.15 * height / fy)
        jacobian = np.array([[fx / z[i], 0, -fx * u / z[i]], [0, fy / z[i], -fy * v / z[i]]])
        sharp = jacobian @ root[i] @ root[i].T @ jacobian.T
        blurred = sharp + 0.3 * np.eye(2)
        opacity = opacities[i]
        if antialias:
            opacity *= np.sqrt(max(np.linalg.det(sharp), 1e-12) / np.linalg.det(blurred))
        offset = np.stack([fx * x[i] / z[i] + cx - column, fy * y[i] / z[i] + cy - row], axis=-1)
        power = 0.5 * np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(blurred), offset)
        a = np.minimum(opacity * np.exp(-power), 0.999)
        a[(opacity * np.exp(-power) < 1 / 255) | (through < 1e-4) | (z[i] > limit)] = 0
        light += (through * a)[..., None] * colour[i]
        distance += through * a * z[i]
        through *= 1 - a
    alpha = 1 - through
    return light, alpha, np.divide(distance, alpha, out=np.zeros_like(alpha), where=alpha > 0)
