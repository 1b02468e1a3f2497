"""Rotations of many worlds at once; unit quaternions are wxyz, in the last axis."""

from __future__ import annotations

import torch


def rotate_vectors(q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Return vectors (..., 3) rotated by unit quaternions (..., 4)."""
    u = q[..., 1:].expand_as(v)
    t = 2 * torch.linalg.cross(u, v)
    return v + q[..., :1] * t + torch.linalg.cross(u, t)


def invert_quaternion(q: torch.Tensor) -> torch.Tensor:
    """Return the inverse of unit quaternions (..., 4)."""
    return torch.cat([q[..., :1], -q[..., 1:]], dim=-1)


def multiply_quaternions(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the quaternions of b's rotation followed by a's, shape (..., 4)."""
    real = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdim=True)
    imaginary = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + torch.linalg.cross(a[..., 1:], b[..., 1:])
    return torch.cat([real, imaginary], dim=-1)


def rotation_angle(q: torch.Tensor) -> torch.Tensor:
    """Return the angle of unit quaternions (..., 4) [rad], 0..pi, shape (...)."""
    # The sine of the half angle is accurate for small rotations, the cosine is not.
    return 2 * torch.atan2(torch.linalg.norm(q[..., 1:], dim=-1), q[..., 0].abs())


def rotation_columns(q: torch.Tensor) -> torch.Tensor:
    """Return the first two columns of the rotation matrices of quaternions (..., 4), concatenated, shape (..., 6).

    The continuous representation of Zhou et al., CVPR 2019, that the paper's observation uses.
    """
    w, x, y, z = q.unbind(-1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z),
            2 * (x * y + w * z),
            2 * (x * z - w * y),
            2 * (x * y - w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z + w * x),
        ],
        dim=-1,
    )


def rotation_from_vector(v: torch.Tensor) -> torch.Tensor:
    """Return the unit quaternions (..., 4) of rotation vectors (..., 3) [rad]."""
    half = 0.5 * torch.linalg.vector_norm(v, dim=-1, keepdim=True)
    # torch.sinc is sin(pi x) / (pi x), so that this is sin(half) / (2 half) without a division by 0.
    return torch.cat([half.cos(), 0.5 * torch.sinc(half / torch.pi) * v], dim=-1)
