from pathlib import Path

import pytest

import concent_warp as cw
from concent_warp.train.distil.student import Student

TINY = cw.DistilCfg(
    states=4,
    images=cw.ImagesCfg(size=24, samples=1, shadows=False),
    network=cw.StudentNetworkCfg(channels=(8, 8), keypoints=8, hidden=(32,)),
    dagger=cw.DaggerCfg(
        iterations=3, worlds=2, steps=3, updates=2, batch=4, beta_iterations=2, warm_up=0, normalise_iterations=2
    ),
)
"""A distillation of a few seconds: 18 samples."""


@pytest.fixture(scope="session")
def teacher() -> cw.Policy:
    return cw.load_policy("shape_sorter")


@pytest.fixture(scope="session")
def folder(teacher: cw.Policy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the run folder of a student."""
    out = tmp_path_factory.mktemp("distil") / "student"
    cw.distil(teacher, TINY, device="cpu", out=out)
    return out


@pytest.fixture(scope="session")
def student(folder: Path) -> Student:
    return cw.load_student(folder)
