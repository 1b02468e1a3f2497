import warnings
from dataclasses import replace

import numpy as np
import pytest

from concent_warp.recording.formats.hdf5 import write_hdf5
from concent_warp.recording.load import load_recording
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.recording.spikes import spikes, without_spikes

SCENE = """<mujoco><worldbody><body name="ball" pos="0 0 1"><freejoint/><geom size="0.02"/></body></worldbody>
<sensor><framepos name="track" objtype="xbody" objname="ball"/>
<framelinvel name="velocity" objtype="xbody" objname="ball"/></sensor></mujoco>"""
RNG = np.random.default_rng(0)
TIME = np.arange(0, 4, 0.01) + RNG.uniform(-1e-3, 1e-3, 400)
PATH = np.stack([0.3 * np.sin(3 * TIME), 0.1 * np.cos(5 * TIME), np.full(400, np.nan)], axis=1)
PATH += RNG.normal(0, 5e-4, PATH.shape)
ROWS = np.array([37, 120, 121 + 80, 390])


def with_spikes():
    value = np.array(PATH)
    value[ROWS, [0, 1, 0, 1]] += [0.05, -0.03, 0.2, 0.04]
    return value


def test_single_readings_far_from_those_beside_them_are_found():
    assert not spikes(TIME, PATH).size
    np.testing.assert_array_equal(spikes(TIME, with_spikes()), ROWS)
    gap = with_spikes()
    gap[200] = gap[202:215] = np.nan
    np.testing.assert_array_equal(spikes(TIME, gap), ROWS)
    near = with_spikes()
    near[ROWS + 3, 0] -= 0.06
    np.testing.assert_array_equal(spikes(TIME, near), np.sort([*ROWS, *ROWS + 3]))


@pytest.mark.parametrize("rebound", [-1.0, 0.0, 0.5, 0.95])
@pytest.mark.parametrize("between", [0.0, 0.3, 0.5])
def test_impacts_are_no_spikes(rebound, between):
    """A ball that hits, rebounds and sticks, or goes on more slowly, without noise and with."""
    j = np.arange(60) - 30 - between
    height = 0.03 * np.where(j < 0, -j, rebound * j) - 5e-4 * j**2
    assert not spikes(np.arange(60) * 0.01, height).size
    assert not spikes(np.arange(60) * 0.01, height + RNG.normal(0, 1e-5, 60)).size


def test_steps_of_an_encoder_and_what_is_frequent_are_no_spikes():
    step = np.round(np.sin(TIME) / 0.0015) * 0.0015
    step[300:] = step[300]
    step[[320, 350]] += 0.0015
    assert not spikes(TIME, step).size
    often = np.array(PATH)
    often[::9, 0] += 0.1
    assert not spikes(TIME, often).size


def test_spikes_of_positions_are_missing_on_reading_and_said(tmp_path):
    track = Channel(TIME, with_spikes())
    demonstration = Demonstration("demo_0", measured={"track": track, "velocity": replace(track)})
    write_hdf5(Recording(SCENE, (demonstration,)), tmp_path / "a.h5")
    with pytest.warns(UserWarning, match=r"left out: 4 of 400 in demo_0, measured/track \(the first at 0\.3"):
        read = load_recording(tmp_path / "a.h5")[0].measured
    assert np.isnan(read["track"].value[ROWS]).all()
    assert np.isfinite(read["track"].value[:, :2]).all(axis=1).sum() == 396
    np.testing.assert_array_equal(read["velocity"].value, with_spikes())
    recording = Recording(SCENE, (Demonstration("demo_0", measured={"track": Channel(TIME, PATH)}),))
    with warnings.catch_warnings(action="error"):
        assert without_spikes(recording) is recording
