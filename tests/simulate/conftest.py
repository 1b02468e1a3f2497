from __future__ import annotations

import numpy as np
import pytest
from pushing import STEPS, make_model

from concent_warp.model import Model
from concent_warp.simulate.engine import Variants
from concent_warp.simulate.mujoco_engine import MujocoEngine


@pytest.fixture(scope="session")
def model() -> Model:
    return make_model()


@pytest.fixture(scope="session")
def engine(model: Model) -> MujocoEngine:
    return MujocoEngine(model, threads=2)


@pytest.fixture(scope="session")
def ctrl() -> np.ndarray:
    """A slow push, shape (STEPS, 1)."""
    return np.linspace(0, 0.08, STEPS)[:, None]


@pytest.fixture(scope="session")
def variants(model: Model, engine: MujocoEngine) -> Variants:
    """Three variants in which all kinds of values differ."""
    rng = np.random.default_rng(0)
    assert model.geometry is not None
    n, s = 3, len(model.geometry)
    qpos = np.tile(engine.compiled.qpos0, (n, 1))
    qpos[:, 1] += [0.0, 0.003, -0.002]
    return Variants(
        n,
        sphere_position=model.geometry.position + rng.normal(0, 5e-4, (n, s, 3)),
        sphere_radius=0.005 * rng.uniform(0.9, 1.1, (n, s)),
        sphere_friction=rng.uniform(0.3, 0.9, (n, s)),
        fields={
            "body_mass": engine.compiled.body_mass * rng.uniform(0.8, 1.2, (n, 1)),
            "dof_frictionloss": np.eye(engine.compiled.nv)[:1] * rng.uniform(0, 0.3, (n, 1)),
            "opt.gravity": np.array([[0, 0, -9.81], [0.1, 0, -9.6], [0, 0.1, -9.9]]),
        },
        qpos=qpos,
        qvel=rng.normal(0, 0.01, (n, engine.compiled.nv)),
    )
