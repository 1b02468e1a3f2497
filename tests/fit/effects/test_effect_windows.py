"""Windows of recordings, sample by sample."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from concent_warp.errors import RecordingError
from concent_warp.estimation.partial_state import PartialState
from concent_warp.fit.effects import observe as observing
from concent_warp.fit.effects.observation import ObservedRecording, first_time, start_spread
from concent_warp.fit.effects.observation_cfg import ObservationCfg
from concent_warp.fit.effects.observe import ProportionalSpan, _calmest, channel_noises, observe
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene
from tests.scenes.swinging import NOISE, drawing, swung

CHAIN = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="fixed" pos="0 1 0"><geom size="0.1"/><site name="spot"/></body>
    <body name="one">
      <joint name="first" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/>
      <body name="two">
        <joint name="second" axis="0 1 0"/><joint name="third" axis="0 0 1"/><geom size="0.1" mass="1"/>
      </body>
    </body>
    <body name="free" pos="0 0 1"><freejoint/><geom size="0.1" mass="1"/><site name="mark"/></body>
  </worldbody>
  <tendon><fixed name="both"><joint joint="first" coef="1"/><joint joint="third" coef="2"/></fixed></tendon>
  <sensor>
    <jointpos name="second" joint="second"/>
    <tendonpos name="tendon" tendon="both"/>
    <framepos name="place" objtype="xbody" objname="free"/>
    <framequat name="turned" objtype="body" objname="free"/>
    <framepos name="fixed" objtype="xbody" objname="fixed"/>
    <framepos name="link" objtype="xbody" objname="two"/>
    <framepos name="mark" objtype="site" objname="mark"/>
    <jointvel name="rate" joint="second"/>
  </sensor>
</mujoco>"""


def test_the_spread_of_an_initial_state_follows_from_the_noise_of_what_shows_it():
    m = mujoco.MjModel.from_xml_string(CHAIN)
    unseen = np.array([1e-3] * 9 + [1e-2] * 9)
    for sensor, dofs in (
        ("second", [1]),
        ("tendon", [0, 2]),
        ("place", [3, 4, 5]),
        ("turned", [6, 7, 8]),
        ("fixed", []),
        ("link", [0]),
        ("mark", [3, 4, 5]),
        ("rate", []),
    ):
        expected = unseen.copy()
        expected[dofs], expected[[9 + d for d in dofs]] = 3 * 2e-4, 3 * 2e-4 / 0.03
        np.testing.assert_allclose(start_spread(m, {sensor: 2e-4}), expected, err_msg=sensor)
    both = start_spread(m, {"fixed": 1.0, "link": 1.0, "place": 2e-4, "second": 1e-5})
    assert both[1] == pytest.approx(3e-5)
    assert both[3] == pytest.approx(6e-4)


def observed(recording: Recording, **noise: float) -> ObservedRecording:
    return ObservedRecording(drawing(recording), recording, noise)


def sampled(value: np.ndarray, start: float = 0.0) -> Channel:
    return Channel(start + 0.01 * np.arange(len(value)), value, NOISE)


def with_channels(**measured: Channel) -> Recording:
    recording = swung(quaternion=True)
    return replace(recording, demonstrations=(replace(recording[0], measured=measured),))


def test_a_window_holds_the_samples_within_it_in_rows_of_the_residuals():
    rng = np.random.default_rng(0)
    angle, turned = rng.normal(size=(30, 1)), rng.normal(size=(30, 4))
    angle[12] = np.nan
    source = observed(with_channels(angle=sampled(angle), turned=sampled(turned)), turned=2e-3, angle=1e-3, other=1.0)
    window = source.window(0, 0.10, 0.15)
    assert window is not None
    first, second = window.readings
    assert (first.channel, first.rows, first.std, first.orientation) == ("turned", slice(0, 18), 2e-3, True)
    assert (second.channel, second.rows, second.std, second.orientation) == ("angle", slice(18, 23), 1e-3, False)
    np.testing.assert_allclose(first.time, 0.01 * np.arange(6), atol=1e-12)
    np.testing.assert_allclose(second.time, [0.0, 0.01, 0.03, 0.04, 0.05], atol=1e-12)
    np.testing.assert_allclose(first.value, turned[10:16] / np.linalg.norm(turned[10:16], axis=1, keepdims=True))
    np.testing.assert_array_equal(second.value, angle[[10, 11, 13, 14, 15]])
    assert window.count == 23
    np.testing.assert_allclose(window.clock[:18], np.repeat(0.10 + 0.01 * np.arange(6), 3))
    np.testing.assert_allclose(window.clock[18:], [0.10, 0.11, 0.13, 0.14, 0.15])
    assert (window.number, window.start, window.end) == (0, 0.10, 0.15)
    np.testing.assert_allclose(window.spread, start_spread(source.model.scene.model, {"angle": 1e-3}))


def test_a_window_without_samples_is_none():
    gap = np.full((30, 1), np.nan)
    gap[25:] = 0.1
    source = observed(with_channels(angle=sampled(gap)), angle=1e-3, turned=1e-3)
    assert source.window(0, 0.0, 0.1) is None
    assert source.window(0, 0.0, 0.24) is None
    found = source.window(0, 0.0, 0.25)
    assert found is not None
    assert found.count == 1


def first(state: PartialState) -> list[float]:
    return [float(state.qpos[0]), float(state.qvel[0])]


def test_a_state_is_the_recorded_one_at_the_start_and_the_measured_one_later(monkeypatch):
    recording = swung()
    source = observed(recording, angle=NOISE)
    d = recording[0]
    seen: list[Any] = []

    def states(times: np.ndarray) -> Any:
        seen.append(times.tolist())
        return SimpleNamespace(qpos=np.array([[7.0], [8.0]]), qvel=np.array([[9.0], [10.0]]))

    monkeypatch.setattr(ObservedRecording, "measured", lambda *_: SimpleNamespace(states=states))
    assert first(source.state(d, 0.0)) == [0.3, 0.0]
    assert first(source.state(d, -0.1)) == [0.3, 0.0]
    assert seen == []
    assert first(source.state(d, 0.5)) == [7.0, 9.0]
    assert first(source.state(replace(d, qvel=None), 0.0)) == [7.0, 9.0]
    assert first(source.state(replace(d, qpos=None), 0.0)) == [7.0, 9.0]
    assert seen == [[0.5], [0.0], [0.0]]
    monkeypatch.setattr(ObservedRecording, "measured", lambda *_: None)
    assert first(source.state(replace(d, qvel=None), 0.0))[0] == 0.3
    bare = replace(d, qpos=None, qvel=None, measured={})
    found = source.state(bare, 0.5)
    assert first(found) == [0.0, 0.0]
    assert found.measured.tolist() == [False]
    read = source.state(replace(d, qpos=None), 0.5)
    assert read.measured.tolist() == [True]
    angle = d.measured["angle"]
    assert first(read) == pytest.approx(
        [float(np.interp(0.5, angle.time, angle.value[:, 0])), first(read)[1]], abs=0.01
    )


def test_what_was_not_seen_has_no_measured_motion():
    recording = swung()
    source = observed(recording, angle=NOISE)
    assert source.measured(recording[0]) is not None
    assert source.measured(replace(recording[0], measured={})) is None


def test_the_first_time_is_that_of_the_channel_that_begins_first():
    d = with_channels(angle=sampled(np.zeros((3, 1)), 0.3), turned=sampled(np.zeros((3, 4)), 0.2))[0]
    assert first_time(d, ["angle", "turned", "other"]) == 0.2
    assert first_time(d, ["angle"]) == 0.3
    assert first_time(d, []) == 0.0


class Rough:
    """A measured motion that is rough at some times."""

    def __init__(self, rough: Any) -> None:
        self._rough = rough

    def scatter_of_both_sides(self, times: np.ndarray) -> np.ndarray:
        return self._rough(times)


def calmest(rough: Any, start: float, length: float) -> float:
    measured: Any = Rough(rough)
    return _calmest(measured, start, length, ObservationCfg())


def test_a_window_ends_at_the_last_calm_time_in_the_later_two_thirds():
    assert calmest(np.ones_like, 3.0, 1.0) == 4.0
    assert calmest(lambda t: np.where(t > 3.5, 2.0, 1.9), 3.0, 1.0) == pytest.approx(3.5)
    assert calmest(lambda t: 5.0 + np.abs(t - 3.7), 3.0, 1.0) == pytest.approx(3.7)
    assert calmest(lambda t: 2.0 + t, 3.0, 1.0) == pytest.approx(3.35)


@pytest.fixture
def cuts(monkeypatch) -> dict[str, Any]:
    """Windows without a simulation: motion keeps close for 0.5 s, and all ends are calm."""
    told: dict[str, Any] = {"reach": 0.5, "measured": SimpleNamespace(), "calls": []}

    def keeps(source: Any, d: Any, start: float, last: float, engine: str, seed: int) -> ProportionalSpan:
        del source, d
        told["calls"].append((start, last, engine, seed))
        return ProportionalSpan(told["reach"], unstable=False)

    monkeypatch.setattr(observing, "proportional_span", keeps)
    monkeypatch.setattr(observing, "_calmest", lambda _, start, reach, __: start + reach)
    monkeypatch.setattr(ObservedRecording, "measured", lambda *_: told["measured"])
    monkeypatch.setattr(
        ObservedRecording, "state", lambda *_: PartialState(np.zeros(1), np.zeros(1), np.ones(1, dtype=bool))
    )
    return told


def spans(recording: Recording, **options: Any) -> list[tuple[int, float, float]]:
    found = observe(drawing(recording), recording, noise={"angle": 1e-3}, **options)
    return [(w.number, round(w.start, 6), round(w.end, 6)) for w in found]


@pytest.mark.usefixtures("cuts")
def test_windows_of_an_unstable_machine_are_little_longer_than_one_that_its_growth_ends(monkeypatch):
    told = iter([(0.3, False), (0.2, True), (0.9, False), (0.25, False), (0.9, False)])
    monkeypatch.setattr(observing, "proportional_span", lambda *_: ProportionalSpan(*next(told)))
    assert spans(swung(seconds=1.3)) == [(0, 0.0, 0.3), (0, 0.3, 0.5), (0, 0.5, 0.8), (0, 0.8, 1.05), (0, 1.05, 1.3)]


def test_windows_follow_one_another_to_the_last_sample(cuts):
    recording = swung(seconds=1.3)
    assert spans(recording, seed=4) == [(0, 0.0, 0.5), (0, 0.5, 1.0), (0, 1.0, 1.3)]
    assert cuts["calls"] == [(0.0, 1.3, "mujoco", 4), (0.5, 1.3, "mujoco", 4), (1.0, 1.3, "mujoco", 4)]
    assert spans(recording, length=0.4) == [(0, 0.0, 0.4), (0, 0.4, 0.8), (0, 0.8, 1.3)]
    assert len(cuts["calls"]) == 3
    assert spans(recording, length=0.6) == [(0, 0.0, 0.6), (0, 0.6, 1.3)]
    assert spans(recording, length=0.58) == [(0, 0.0, 0.58), (0, 0.58, 1.16), (0, 1.16, 1.3)]


def test_where_the_motion_was_not_measured_a_demonstration_is_one_window(cuts):
    cuts["measured"] = None
    assert spans(swung(seconds=1.3)) == [(0, 0.0, 1.3)]
    assert cuts["calls"] == []


def test_a_demonstration_begins_at_its_commands_or_else_at_its_first_sample(cuts):
    cuts["measured"] = None
    recording = swung(seconds=1.0)
    d = recording[0]
    late = Channel(d.measured["angle"].time[20:], d.measured["angle"].value[20:], NOISE)
    d = replace(d, measured={"angle": late})
    for qpos, action, start in ((d.qpos, {}, 0.0), (None, d.action, 0.0), (None, {}, 0.2), (d.qpos, d.action, 0.0)):
        given = replace(d, qpos=qpos, action=action)
        assert spans(replace(recording, demonstrations=(given, given))) == [(0, start, 1.0), (1, start, 1.0)]


def test_a_recording_in_which_nothing_falls_into_a_window_is_refused(cuts):
    recording = swung()
    silent = replace(recording, demonstrations=(replace(recording[0], measured={}),))
    with pytest.raises(RecordingError, match="nothing was measured that a model could be compared with"):
        spans(silent)
    assert cuts["calls"] == []


SENSORS = """
<mujoco>
  <worldbody>
    <body name="arm"><joint name="hinge" axis="0 1 0"/><geom size="0.1" mass="1"/></body>
    <body name="box"><joint name="slide" type="slide"/><geom size="0.1" mass="1"/></body>
  </worldbody>
  <sensor>
    <jointpos name="angle" joint="hinge"/><jointvel name="rate" joint="hinge"/>
    <jointpos name="place" joint="slide"/><jointvel name="speed" joint="slide"/>
    <jointactuatorfrc name="force" joint="slide"/>
  </sensor>
</mujoco>"""


def recorded(**measured: Any) -> Recording:
    """Return a recording of two demonstrations with the same channels."""
    channels = {name: Channel(0.1 * np.arange(len(v)), np.array(v, float)[:, None]) for name, v in measured.items()}
    one = Demonstration("a", qpos=np.zeros(2), qvel=np.zeros(2), measured=channels)
    return Recording(SENSORS, (one, replace(one, name="b")))


def test_a_channel_that_never_changes_has_the_default_noise_of_its_unit():
    still = np.zeros(12)
    found = channel_noises(Model(Scene(SENSORS)), recorded(angle=still, rate=still, place=still, speed=still))
    assert found == {"angle": 1e-3, "rate": 1e-2, "place": 1e-3, "speed": 1e-2}
    assert channel_noises(Model(Scene(SENSORS)), recorded(force=still)) == {"force": 1e-2}


def test_values_that_are_finite_count_over_all_demonstrations():
    model = Model(Scene(SENSORS))
    gap = np.zeros(12)
    gap[6:] = np.nan
    assert channel_noises(model, recorded(angle=gap)) == {"angle": 1e-3}
    gap[5] = np.nan
    with pytest.raises(RecordingError, match="too little was measured") as refused:
        channel_noises(model, recorded(angle=gap))
    assert "10" in str(refused.value)
    one = np.array([0.0, np.nan])
    assert set(channel_noises(model, recorded(angle=np.zeros(12), rate=one))) == {"angle", "rate"}
    with pytest.raises(RecordingError, match="too little was measured"):
        channel_noises(model, recorded(rate=np.array([np.nan, np.nan])))
    lone = recorded(angle=np.zeros(12), rate=one)
    first = replace(lone[1], measured={"angle": lone[1].measured["angle"]})
    assert set(channel_noises(model, replace(lone, demonstrations=(lone[0], first)))) == {"angle"}
