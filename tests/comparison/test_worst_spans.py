import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from concent_warp.comparison.compare import compare_replays
from concent_warp.comparison.phases import Phase
from concent_warp.comparison.residuals import Residual
from concent_warp.comparison.worst_spans import (
    WorstSpanCfg,
    _channel_spans,
    _smoothed,
    find_worst_spans,
    rank_worst_spans,
)
from concent_warp.estimation.sensors import Kind
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

CFG = WorstSpanCfg()
TIME = np.arange(0, 4, 0.01)
RNG = np.random.default_rng(0)


def residual(shift, channel="block_position", kind: Kind = "position", unit="m", body="block", std=1e-4):
    """A residual of white noise and of `shift` (T, 3)."""
    value = np.random.default_rng(len(channel)).normal(0, std, (len(TIME), 3)) + shift
    return Residual(
        channel=channel, kind=kind, unit=unit, body=body, time=TIME, value=value, error=np.linalg.norm(value, axis=1),
        noise=std * np.sqrt(3), std=std, source="stated", extent=0.3, local=kind == "orientation",
    )  # fmt: skip


def bump(centre, width, size, axis=0):
    shift = np.zeros((len(TIME), 3))
    shift[:, axis] = size * np.exp(-0.5 * ((TIME - centre) / width) ** 2)
    return shift


PHASES = (Phase("free", -np.inf, 2.5), Phase("insert", 2.5, np.inf))


def test_two_bumps_are_two_places_the_worse_first():
    found = find_worst_spans(
        [residual(bump(1, 0.1, 2e-3) + bump(3.2, 0.15, -4e-3, axis=2))], {None: PHASES}, None, "demo_0", CFG
    )
    assert [p.phase for p in found] == ["insert", "free"]
    assert [p.peak for p in found] == pytest.approx([3.2, 1.0], abs=0.03)
    assert (found[0].start, found[0].end) == pytest.approx((3.2 - 0.15 * 1.18, 3.2 + 0.15 * 1.18), abs=0.03)
    assert [p.direction for p in found] == ["along -z", "along +x"]
    assert found[0].ratio == pytest.approx(found[0].error / (1e-4 * np.sqrt(3)))
    assert found[0].ratio == pytest.approx(20, rel=0.2)
    assert found[0].onset == pytest.approx(3.2 - 0.15 * np.sqrt(2 * np.log(4e-3 / (CFG.min_ratio * 1.73e-4))), abs=0.04)


@pytest.mark.parametrize("seed", range(20))
def test_noise_alone_has_no_places(seed):
    value = np.random.default_rng(seed).normal(0, 1e-4, (len(TIME), 3))
    quiet = replace(residual(0), value=value, error=np.linalg.norm(value, axis=1))
    assert list(_channel_spans(quiet, PHASES, None, "demo_0", CFG)) == []


def test_channels_of_one_body_that_fail_together_are_one_place():
    wrong = bump(3, 0.2, 3e-3)
    turned = residual(bump(3.05, 0.2, 0.1, axis=1), "block_orientation", "orientation", "rad", std=1e-2)
    other = residual(wrong, "lid_position", body="lid")
    found = find_worst_spans([residual(wrong), turned, other], {None: PHASES}, None, "demo_0", CFG)
    assert {p.channels for p in found} == {("block_position", "block_orientation"), ("lid_position",)}
    merged = next(p for p in found if p.body == "block")
    assert "block position (and orientation), insert phase" in merged.sentence()
    assert "along +x" in merged.sentence()


def test_a_shoulder_of_a_peak_is_no_second_place():
    decay = np.where(TIME > 1, np.exp(-(TIME - 1) / 0.8), 0)[:, None] * [5e-3, 0, 0]
    assert len(list(_channel_spans(residual(decay), PHASES, None, "d", CFG))) == 1


def test_an_error_that_stays_is_traced_to_the_phase_it_arose_in():
    jump = np.interp(TIME, [2.0, 2.4], [0, 4e-3])[:, None] * [1, 0, 0]
    place = next(_channel_spans(residual(jump), PHASES, None, "d", CFG))
    assert (place.phase, place.arose) == ("insert", "free")
    assert place.sentence().endswith("mostly from the free phase")
    late = next(_channel_spans(residual(bump(3.2, 0.1, 4e-3)), PHASES, None, "d", CFG))
    assert late.arose == late.phase == "insert"
    assert "mostly from" not in late.sentence()


def test_a_residual_that_swings_points_to_and_fro():
    wave = np.sin(100 * TIME)[:, None] * [0, 2e-3, 0]
    place = next(_channel_spans(residual(wave), (), None, "d", CFG))
    assert place.direction == "to and fro along y"
    assert place.phase is None
    assert np.linalg.norm(place.vector) < 0.5


def test_a_diverged_replay_is_the_worst_place_and_stays_json():
    r = residual(bump(1, 0.1, 2e-3))
    lost = replace(r, error=np.where(TIME > 2, np.inf, r.error))
    found = find_worst_spans([lost], {None: PHASES}, None, "demo_0", CFG)
    assert found[0].size == "diverged"
    assert found[0].start == pytest.approx(2.01)
    assert found[1].peak == pytest.approx(1, abs=0.03)


def test_without_known_noise_a_place_is_reported_in_units():
    exact = replace(residual(bump(1, 0.1, 0.02)), noise=None, std=None)
    place = next(_channel_spans(exact, (), None, "d", CFG))
    assert place.ratio is None
    assert place.size.endswith(" mm")
    assert "noise" not in place.sentence()


def test_smoothing_counts_only_what_was_measured():
    ratio = np.where(np.arange(400) % 3 == 0, np.nan, 2.0)
    assert _smoothed(TIME, ratio, CFG) == pytest.approx(2.0)
    assert _smoothed(TIME[:1], np.array([2.0]), CFG) == pytest.approx([2.0])


PUSH = """
<mujoco>
  <option timestep="0.005"/>
  <custom><text name="concent_objects" data="block box"/></custom>
  <worldbody>
    <geom name="table" type="plane" size="1 1 .1" friction=".3 .005 .0001"/>
    <body name="pusher" pos="-.13 0 .04">
      <joint name="rail" type="slide" axis="1 0 0"/><geom type="capsule" fromto="0 -.03 0 0 .03 0" size=".02" mass="1"/>
    </body>
    <body name="block" pos="0 0 .03"><freejoint/><geom type="box" size=".03 .03 .03" mass=".1"/></body>
    <body name="box" pos="{stop} 0 .03">
      <geom name="rim" type="box" size=".02 .06 .005" pos="0 0 .025"/><geom type="box" size=".02 .06 .025"/></body>
  </worldbody>
  <actuator><position name="drive" joint="rail" kp="300" kv="30"/></actuator>
  <sensor>
    <jointpos name="rail" joint="rail"/>
    <framepos name="block_position" objtype="xbody" objname="block"/>
    <framequat name="block_orientation" objtype="xbody" objname="block"/>
  </sensor>
</mujoco>
"""


@pytest.fixture(scope="module")
def pushed():
    """A block pushed against a box that really stands 8 mm farther away than in the model."""
    m = mujoco.MjModel.from_xml_string(PUSH.format(stop=0.118))
    d = mujoco.MjData(m)
    command, rows = 0.19 * np.clip(TIME[:200], 0, 1), []
    for value in command:
        d.ctrl[0] = value
        mujoco.mj_forward(m, d)
        rows.append(d.sensordata.copy())
        mujoco.mj_step(m, d, nstep=2)
    rows = np.array(rows) + np.random.default_rng(0).normal(0, 1e-4, (200, m.nsensordata))
    time = TIME[:200]
    measured = {
        "rail": Channel(time, rows[:, :1], 1e-4),
        "block_position": Channel(time, rows[:, 1:4], 1e-4),
        "block_orientation": Channel(time, rows[:, 4:], 2e-4),
    }
    demonstration = Demonstration(
        "demo_0", qpos=m.qpos0.copy(), qvel=np.zeros(m.nv), action={"drive": Channel(time, command)}, measured=measured
    )
    again = replace(demonstration, name="demo_1")
    return compare_replays(
        {"model": Model(Scene(PUSH.format(stop=0.11)))}, Recording(PUSH, (demonstration, again)), "mujoco"
    )


def test_the_worst_place_names_body_phase_partner_and_direction(pushed):
    place = next(p for p in pushed.worst_spans if p.channels[0] == "block_position")
    assert "along +x" in place.direction
    assert place.against[0].startswith("box (-x")
    assert place.start > 0.3
    assert place.phase in pushed.phase_names
    assert place.point[0] == pytest.approx(0.03, abs=3e-3)
    assert place.recurs == 2
    assert "against box (-x" in place.sentence(demonstration=True)
    assert place.sentence(demonstration=True).startswith("demo_")


def test_joints_name_the_contacts_of_the_body_that_they_move(pushed):
    place = next(p for p in pushed.worst_spans if p.channels[0] == "rail")
    assert place.against[0].startswith("block (-x")
    assert place.direction == "measured value more than the model's"


def test_places_are_in_the_json_with_their_sentence(pushed):
    document = json.loads(json.dumps(pushed.to_json(), allow_nan=False))
    assert [p["sentence"] for p in document["worst_spans"]] == [
        p.sentence(demonstration=True) for p in pushed.worst_spans
    ]
    assert document["phases_are"] == "phases of motion"
    assert document["summaries"][0]["ratio"] > 3


def test_places_alike_in_many_demonstrations_leave_room_for_others():
    place = next(_channel_spans(residual(bump(1, 0.1, 4e-3)), PHASES, None, "d", CFG))
    many = [replace(place, demonstration=f"demo_{i}", ratio=50.0 + i) for i in range(30)]
    other = replace(place, channels=("lid_position",), demonstration="demo_3", ratio=5.0)
    found = rank_worst_spans([other, *many], CFG)
    assert [p.ratio for p in found] == [79, 78, 77, 5]
    assert [p.recurs for p in found] == [30, 30, 30, 1]
