from __future__ import annotations

import pytest

from concent_warp.reality.record import RealityCfg, Truth, record
from concent_warp.recording.recording import Recording


@pytest.fixture(scope="session")
def shown() -> tuple[RealityCfg, Recording, list[Truth]]:
    """Demonstrations by the expert on seeds 0, 1 and 2, with nothing hidden and no images."""
    cfg = RealityCfg()
    recording, truths = record(cfg, [0, 1, 2])
    return cfg, recording, truths
