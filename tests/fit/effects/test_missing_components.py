"""Readings of which components are missing, one by one, from the recording to the diagnosis."""

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

from concent_warp.comparison.compare import compare
from concent_warp.diagnosis.check_data import check_data
from concent_warp.estimation.noise import channel_noise
from concent_warp.fit.effects.fit import fit_effects
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.simulate.replay import initial_state
from concent_warp.simulate.replay_recording import replay

SCENE = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="ball" pos="0 0 2"><freejoint/><geom size="0.05" mass="0.05"/></body>
  </worldbody>
  <sensor><framepos name="ball" objtype="xbody" objname="ball"/></sensor>
</mujoco>
"""
DENSITY = 4.0
TIME = np.arange(0, 0.6, 0.01)


def recording(missing: np.ndarray | None = None) -> Recording:
    """Return a throw of a ball through air, with 0.2 mm of noise, without the components that are missing."""
    start: dict[str, Any] = {"qpos": np.array([0.0, 0, 2, 1, 0, 0, 0]), "qvel": np.array([3.0, 1.5, 2, 0, 0, 0])}
    thrown = Recording(SCENE, (Demonstration("demo_0", **start, measured={"ball": Channel(TIME, np.ones((60, 3)))}),))
    model = Model.from_recording(thrown).add_effect("air_drag", values={"density": DENSITY})
    value = np.asarray(replay(model, thrown)["demo_0"].sensordata[0])[np.arange(60) * 5]
    value += 2e-4 * np.random.default_rng(0).normal(size=value.shape)
    if missing is not None:
        value[missing] = np.nan
    demonstration = Demonstration("demo_0", **start, measured={"ball": Channel(TIME, value)})
    return Recording(SCENE, (demonstration,))


SOME = np.random.default_rng(1).random((len(TIME), 3)) < 0.3
HEIGHT = np.tile([True, True, False], (len(TIME), 1))


@pytest.mark.parametrize("missing", [None, SOME, HEIGHT], ids=["whole", "some missing", "heights alone"])
def test_drag_is_found_from_what_was_measured(missing):
    measured = recording(missing)
    model = Model.from_recording(measured).add_effect("air_drag")
    (fitted,) = fit_effects(model, measured).model.effects
    assert fitted.values == pytest.approx((DENSITY,), rel=0.1)


def test_more_is_known_from_rows_that_miss_a_component_than_without_them():
    partial = np.asarray(SOME.any(axis=1))
    with_rows, without = (
        channel_noise(recording(m).demonstrations[0].measured["ball"], "position") for m in (SOME, None)
    )
    assert with_rows.std == pytest.approx(without.std, rel=0.5)
    found = fit_effects(Model.from_recording(recording(SOME)).add_effect("air_drag"), recording(SOME))
    whole_rows = np.where(partial[:, None], True, SOME)
    fewer = fit_effects(Model.from_recording(recording(SOME)).add_effect("air_drag"), recording(whole_rows))
    (low, high), (lower, higher) = (f.model.effects[0].intervals[0] for f in (found, fewer))
    assert high - low < higher - lower


@pytest.mark.parametrize("missing", [SOME, HEIGHT])
def test_a_comparison_counts_what_was_measured(missing):
    measured = recording(missing)
    result = compare({"model": Model.from_recording(measured)}, measured)
    residual = result.residual("model", "demo_0", "ball")
    assert np.isfinite(residual.error).sum() == (~missing).any(axis=1).sum()
    assert residual.std == pytest.approx(2e-4, rel=0.5)


def test_the_initial_state_takes_each_component_where_it_is_first_known():
    measured = recording(np.where(np.arange(len(TIME))[:, None] < [1, 2, 0], True, False)).demonstrations[0]
    value = measured.measured["ball"].value
    qpos, _ = initial_state(mujoco.MjModel.from_xml_string(SCENE), replace(measured, qpos=None, qvel=None))
    assert qpos[:3].tolist() == [value[1, 0], value[2, 1], value[0, 2]]


def test_heights_alone_are_not_called_missing():
    assert check_data(recording(HEIGHT)) == []
