from __future__ import annotations

import pytest

from concent_warp.reality.record import RealityCfg, record
from tests.perception.grasp_films import Film, filmed


@pytest.fixture(scope="session")
def performed():
    return record(RealityCfg(), [1000])


@pytest.fixture(scope="session")
def textured(performed) -> Film:
    return filmed(performed, pattern=True)


@pytest.fixture(scope="session")
def plain(performed) -> Film:
    return filmed(performed, pattern=False)
