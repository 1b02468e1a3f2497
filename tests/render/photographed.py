"""Posed images of a ball of splats, from cameras all around it."""

import numpy as np
import torch

from concent_warp.render.splats.rasterise import Rasteriser, intrinsics_of
from concent_warp.render.splats.splats import Splats
from concent_warp.render.splats.views import SplatViews

STILL = torch.tensor([[[0.0, 0, 0, 1, 0, 0, 0]]])


def ball(count=800, radius=0.03):
    """Opaque splats on a sphere, colours changing across it."""
    rng = np.random.default_rng(0)
    sides = rng.normal(size=(count, 3))
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    colour = 0.5 + 0.4 * np.sin(5 * sides)
    values = (radius * sides, rng.normal(size=(count, 4)), np.full((count, 3), 0.0025), np.full(count, 0.95))
    harmonics = (colour[:, None] - 0.5) / 0.28209479
    return Splats(*(torch.tensor(v, dtype=torch.float32) for v in (*values, harmonics)))


def cameras(count, distance=0.25, middle=(0, 0, 0)):
    """Poses around a place, shape (count, 4, 4)."""
    poses = []
    for k in range(count):
        z = 0.9 - 1.8 * (k + 0.5) / count
        backward = np.array([np.cos(2.4 * k) * np.sqrt(1 - z**2), np.sin(2.4 * k) * np.sqrt(1 - z**2), z])
        right = np.cross([0, 0, 1.0], backward)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(backward, right), backward], axis=1)
        pose[:3, 3] = np.array(middle) + distance * backward
        poses.append(pose)
    return np.stack(poses)


def photographed(count=16, size=48, splats=None):
    """Return views of a ball at the origin."""
    splats = splats or ball()
    poses = cameras(count)
    matrix = intrinsics_of(20.0, size, size)
    views = SplatViews(
        np.zeros((count, size, size, 4), np.uint8), poses, np.tile(matrix.double().numpy(), (count, 1, 1)), True
    )
    rasteriser = Rasteriser([splats], size, size)
    for v, pose in enumerate(torch.tensor(views.camera_poses(), dtype=torch.float32)):
        layer = rasteriser.render(STILL, pose, matrix)
        alpha = layer.alpha[0, 0, ..., None]
        rgba = torch.cat([layer.rgb[0, 0] / alpha.clamp(min=1e-3), alpha], dim=-1)
        views.rgba[v] = (255 * rgba.clamp(0, 1)).round().numpy().astype(np.uint8)
    return views
