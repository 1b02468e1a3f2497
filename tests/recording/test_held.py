from dataclasses import replace

import numpy as np
import pytest

from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.held import from_release, release_time
from concent_warp.recording.load import load_recording
from concent_warp.recording.recording import Channel, Demonstration, Recording

SCENE = """<mujoco><worldbody><body name="ball" pos="0 0 1"><freejoint/><geom size="0.02"/></body></worldbody>
<sensor><framepos name="track" objtype="xbody" objname="ball"/><framepos name="other" objtype="xbody" objname="ball"/>
</sensor></mujoco>"""
DRIVEN = """<mujoco><worldbody><body name="ball" pos="0 0 1"><joint name="z" type="slide" axis="0 0 1"/>
<geom size="0.02"/></body></worldbody><actuator><motor name="z" joint="z"/></actuator>
<sensor><framepos name="track" objtype="xbody" objname="ball"/></sensor></mujoco>"""


def dropped(held, rate=120.0, noise=1e-3, seed=0):
    """Heights of a ball that is let go after a time [s]."""
    time = np.arange(0, held + 0.5, 1 / rate)
    fall = np.maximum(time - held, 0)
    z = 2 - 4.905 * fall**2 + np.random.default_rng(seed).normal(0, noise, len(time))
    return Channel(time, np.stack([np.full(len(z), np.nan)] * 2 + [z], axis=1))


def one(**measured):
    return Demonstration("demo_0", measured=measured)


@pytest.mark.parametrize("held", [0.2, 0.5, 2.0])
@pytest.mark.parametrize("noise", [0.0, 1e-5, 1e-3])
@pytest.mark.parametrize("seed", range(3))
def test_the_release_is_found_within_a_few_readings(held, noise, seed):
    found = release_time(one(track=dropped(held, noise=noise, seed=seed)))
    assert found is not None
    assert held <= found < held + 0.06


def test_a_motion_from_the_beginning_on_was_not_held():
    time = np.arange(0, 2, 0.005)
    rng = np.random.default_rng(1)
    for seed in range(20):
        assert release_time(one(track=dropped(0.0, seed=seed))) is None
        assert release_time(one(track=dropped(0.0, 500.0, 3e-4, seed=seed))) is None
        swing = 0.5 * np.cos(5 * time + 0.3 * seed) + rng.normal(0, 5e-4, len(time))
        assert release_time(one(angle=Channel(time, swing[:, None]))) is None
    still = Channel(time, rng.normal(0, 1e-3, (400, 1)))
    assert release_time(one(angle=still)) is None


def test_what_moves_first_counts():
    both = one(track=dropped(0.5), other=dropped(0.3))
    assert release_time(both) == pytest.approx(0.33, abs=0.04)
    assert release_time(one(track=dropped(0.5), other=dropped(0.0))) is None


def test_reading_begins_with_the_release_unless_something_drives_or_the_start_is_stated(tmp_path):
    write_hdf5(
        Recording(SCENE, (one(track=dropped(0.5)), replace(one(track=dropped(0.0)), name="demo_1"))), tmp_path / "a.h5"
    )
    with pytest.warns(UserWarning, match=r"so it was held; times are counted from its release: demo_0 at 0\.5"):
        read = load_recording(tmp_path / "a.h5")
    track = read["demo_0"].measured["track"]
    assert track.time[0] == 0
    assert len(track.time) < 60
    assert track.value[0, 2] == pytest.approx(2, abs=0.02)
    assert read["demo_1"].measured["track"].time[-1] == pytest.approx(0.49, abs=0.01)
    driven = Recording(DRIVEN, (one(track=dropped(0.5)),))
    assert from_release(driven) is driven
    stated = Recording(SCENE, (replace(one(track=dropped(0.5)), qpos=np.array([0, 0, 2.0, 1, 0, 0, 0])),))
    assert from_release(stated) is stated
