"""Random body poses as MuJoCo-Warp holds them, and plain float64 transforms, for tests of kernels on many worlds."""

import numpy as np
import pytest
import torch
import warp as wp

on_each_device = pytest.mark.parametrize(
    "device",
    [
        "cpu",
        pytest.param(
            "cuda:0",
            marks=[pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")],
        ),
    ],
)


def turn(quaternion, vector):
    """Rotate by a wxyz quaternion, in float64, by its matrix."""
    w, x, y, z = quaternion
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return vector @ matrix.T


def turn_back(quaternion, vector):
    return turn(quaternion * np.array([1, -1, -1, -1]), vector)


class Poses:
    """Poses of all worlds: NumPy float64, and arrays on a device that `upload` fills."""

    def __init__(self, worlds, bodies, device, *, spread=0.3, seed=0, stages=1):
        rng = np.random.default_rng(seed)
        # Rounded to float32 at once, so that a reference starts from the same numbers.
        self.position = rng.uniform(-spread, spread, (worlds, bodies, 3)).astype(np.float32).astype(float)
        quaternion = rng.normal(size=(worlds, bodies, 4))
        quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
        self.quaternion = quaternion.astype(np.float32).astype(float)
        self.stage: np.ndarray = np.array(rng.integers(0, stages, worlds))
        self.xpos = wp.zeros((worlds, bodies), dtype=wp.vec3, device=device)
        self.xquat = wp.zeros((worlds, bodies), dtype=wp.quat, device=device)
        self.stages = wp.zeros(worlds, dtype=wp.int32, device=device)
        self.upload()

    def upload(self):
        for array, values in (
            (self.xpos, self.position),
            (self.xquat, self.quaternion),
            (self.stages, self.stage),
        ):
            array.assign(values.astype(np.int32 if array.dtype == wp.int32 else np.float32))

    @property
    def arrays(self):
        return self.xpos, self.xquat, self.stages


def outputs(kernel, names):
    """Copies of the named outputs as NumPy arrays."""
    return {name: getattr(kernel, name).numpy().copy() for name in names}
