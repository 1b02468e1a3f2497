import pytest

from concent_warp.perception.calibration.cfg import CalibrateCfg, CalibrationTargetCfg
from concent_warp.recording.recording import Recording
from tests.perception.calibration.filming import SIZE, Filming, film


@pytest.fixture(scope="session")
def on_hand() -> Recording:
    return film(Filming())


@pytest.fixture(scope="session")
def fixed() -> Recording:
    return film(Filming(camera_on_hand=False, seed=1))


@pytest.fixture
def cfg() -> CalibrateCfg:
    return CalibrateCfg(CalibrationTargetCfg(tag_size=SIZE))
