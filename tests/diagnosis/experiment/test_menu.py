"""The menu of motions that may be suggested, each motion to its last number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from concent_warp.diagnosis.experiment.cfg import MotionMenuCfg
from concent_warp.diagnosis.experiment.joint_motions import Drives, _top_speed, drive_motions
from concent_warp.diagnosis.experiment.motions import ProposedMotion, RecordedRange, _unchanged, slope_turned
from concent_warp.diagnosis.experiment.object_motions import ThrowableBody, _roll, body_motions
from concent_warp.diagnosis.experiment.payloads import _above, payload_links, payload_text
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

XML = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <geom name="table" type="plane" size="2 2 .1"/>
  <body name="ghost" pos="0 0 3"><freejoint/><geom size=".01"/></body>
  <body name="rail" pos="-.5 0 .4"><joint name="reach" type="slide" axis="1 0 0"/>
    <geom type="box" size=".02 .05 .01" mass=".4" contype="0" conaffinity="0"/>
    <body name="hand"><joint name="turn" axis="0 0 1"/>
      <geom type="box" size=".02 .05 .01" mass=".2" contype="0" conaffinity="0"/></body></body>
  <body name="block" pos=".1 0 .02"><freejoint/><geom name="block" {shape} mass=".3"/></body>
</worldbody>
<actuator><motor name="spare" joint="reach"/><position name="reach" joint="reach" kp="500" kv="20"/>
  <position name="turn_drive" joint="turn" kp="5" kv=".2"/></actuator>
<sensor><jointpos name="reach_position" joint="reach"/>
  <framepos name="block_position" objtype="xbody" objname="block"/>
  <framequat name="block_orientation" objtype="xbody" objname="block"/></sensor></mujoco>"""
BOX = 'type="box" size=".03 .02 .02"'
BALL = 'type="sphere" size=".02"'
TIME = np.arange(0, 2.001, 0.02)
YAW = 0.4


def bench(shape: str = BOX, *, lift: float = 0.0, speed: float = 0.5, turning: bool = True) -> RecordedRange:
    """Return what was recorded of a drive and of an object that moves along y and lies turned by `YAW`."""
    model = Model(Scene(XML.format(shape=shape)))
    m = model.scene.model
    qpos, qvel = m.qpos0.copy(), np.zeros(m.nv)
    qpos[11] += lift
    qpos[12:16] = [np.cos(YAW / 2), 0, 0, np.sin(YAW / 2)]
    qvel[9:14] = [0.3 * speed, 0.4 * speed, 0.2, 1.0, 0.5]
    action = {
        "spare": Channel(np.array([0.0]), np.array([0.7])),
        "reach": Channel(TIME, 0.1 + 0.05 * TIME + 0.1 * (TIME > 1)),
        "turn_drive": Channel(TIME, 0.3 * np.sin(TIME) if turning else 0 * TIME + 0.2),
    }
    late = np.linspace(0, 1.2, 20)
    measured = {"reach_position": Channel(late, late[:, None])}
    long = Demonstration("long", qpos=qpos, qvel=qvel, action=action, measured=measured)
    short_action = {name: Channel(c.time[:30], c.value[:30]) for name, c in action.items()} | {
        "reach": Channel(TIME[:30], 0 * TIME[:30] - 0.05)
    }
    short = Demonstration("short", qpos=m.qpos0.copy(), qvel=0 * qvel, action=short_action, measured={})
    noise = {"reach_position": 1e-4, "block_position": 3e-4, "block_orientation": 3e-3}
    return RecordedRange(model, Recording(model.scene.xml, (short, long)), noise)


def by_name(motions) -> dict[str, list[ProposedMotion]]:
    """Return motions by their names."""
    found: dict[str, list[ProposedMotion]] = {}
    for motion in motions:
        found.setdefault(motion.name, []).append(motion)
    return found


def thrown(known: RecordedRange) -> ThrowableBody:
    """Return the block."""
    return ThrowableBody(known, known.m.body("block").id, "mujoco")


def test_a_throwable_body_has_its_last_pose_and_its_speed():
    known = bench()
    toy = thrown(known)
    assert (toy.name, toy.at, toy.dof) == ("block", 9, 8)
    assert toy.at == known.m.jnt_qposadr[known.m.body_jntadr[toy.body]]
    slow = thrown(
        RecordedRange(
            known.model, replace(known.recording, demonstrations=known.recording.demonstrations[:1]), known.noise
        )
    )
    assert slow.speed == 0.1


def test_poses_are_shifted_and_turned_in_the_world():
    known = bench()
    toy, rng = thrown(known), np.random.default_rng(0)
    qpos = rng.normal(size=known.m.nq)
    qpos[12:16] /= np.linalg.norm(qpos[12:16])
    before = qpos.copy()
    moved = toy.pose(qpos, np.array([0.1, 0.2, 0.3]), np.array([0.3, -0.2, 0.5]))
    np.testing.assert_array_equal(qpos, before)
    np.testing.assert_allclose(moved[9:12] - qpos[9:12], [0.1, 0.2, 0.3])
    turn = Rotation.from_quat(moved[12:16], scalar_first=True)
    expected = Rotation.from_rotvec([0.3, -0.2, 0.5]) * Rotation.from_quat(qpos[12:16], scalar_first=True)
    assert (turn * expected.inv()).magnitude() == pytest.approx(0, abs=1e-9)
    np.testing.assert_array_equal(moved[:9], qpos[:9])
    launch, spin = np.array([1.0, 2.0, 3.0]), np.array([0.3, 0.6, -0.9])
    motion = toy.motion("n", "t", 9.0, qpos, launch, spin)
    np.testing.assert_allclose(motion.qvel[8:11], launch)
    turned = Rotation.from_quat(qpos[12:16], scalar_first=True)
    np.testing.assert_allclose(turned.apply(motion.qvel[11:14]), spin)
    assert (motion.qvel[:8] == 0).all()
    assert motion.duration == 2.5
    assert toy.motion("n", "t", 0.1, qpos).duration == 0.5
    assert toy.motion("n", "t", 1.5, qpos).duration == 1.5
    assert motion.change is _unchanged
    np.testing.assert_array_equal(motion.action["reach"].value, [-0.05])


def test_the_rest_pose_of_a_block_is_its_simulated_one():
    resting = thrown(bench())
    assert resting.rest is not None
    assert resting.rest[11] == pytest.approx(0.02, abs=1e-3)
    np.testing.assert_array_equal(resting.rest[:9], bench().starts[0][0][:9])
    known = bench()
    falling = replace(known, cfg=replace(MotionMenuCfg(), settling_time=0.0))
    assert thrown(RecordedRange(known.model, known.recording, known.noise, falling.cfg)).rest is not None
    strict = replace(MotionMenuCfg(), rest_speed=0.0)
    assert thrown(RecordedRange(known.model, known.recording, known.noise, strict)).rest is None


def object_bench(shape: str = BOX, lift: float = 0.0) -> tuple[RecordedRange, ThrowableBody, np.ndarray, float]:
    """Return what was recorded, the block, where it rests, and its speed."""
    known = bench(shape, lift=lift)
    toy = thrown(known)
    assert toy.rest is not None
    return known, toy, toy.rest, toy.speed


def test_pushes_slide_the_object_along_each_axis():
    known, toy, rest, v = object_bench()
    made = by_name(body_motions(known, "mujoco", tilted=False))
    assert v == pytest.approx(np.linalg.norm([0.15, 0.2, 0.2]), abs=0.2)
    slides = made["slide"]
    directions = [(1, 0), (0, 1), (-1, 0), (0, -1), (0.5, 0)]
    assert [m.text for m in slides] == [
        f"push block off along {axis} at {s * v:.2g} m/s and let it slide"
        for axis, s in (("+x", 1), ("+y", 1), ("-x", 1), ("-y", 1), ("+x", 0.5))
    ]
    for motion, (x, y) in zip(slides, directions, strict=True):
        np.testing.assert_allclose(motion.qvel[8:14], [x * v, y * v, 0, 0, 0, 0], atol=1e-12)
        assert motion.duration == pytest.approx(max(0.3 + np.hypot(x, y) * v / 1.5, 0.5))
        np.testing.assert_array_equal(motion.qpos, rest)
    turned = made["slide of the turned object"]
    assert [m.text for m in turned] == [
        f"turn block by {d} deg, push it off along +x at {v:.2g} m/s and let it slide" for d in (90, 180)
    ]
    for motion, angle in zip(turned, (np.pi / 2, np.pi), strict=True):
        np.testing.assert_allclose(motion.qpos, toy.pose(rest, np.zeros(3), np.array([0, 0, angle])))
        np.testing.assert_allclose(motion.qvel[8:14], [v, 0, 0, 0, 0, 0])
        assert motion.duration == pytest.approx(max(0.3 + v / 1.5, 0.5))
    spins = made["spin in place"]
    assert [m.text for m in spins] == ["spin block in place at 3 rad/s", "spin block in place at 10 rad/s"]
    for motion, rate in zip(spins, (3, 10), strict=True):
        np.testing.assert_allclose(motion.qvel[8:14], [0, 0, 0, 0, 0, rate], atol=1e-2)
        assert motion.duration == 2.5
    (both,) = made["slide and spin"]
    assert both.text == f"push block off along +x at {v:.2g} m/s, spinning at 10 rad/s"
    np.testing.assert_allclose(both.qvel[8:14], [v, 0, 0, 0, 0, 10], atol=1e-2)
    assert both.duration == pytest.approx(max(0.3 + v / 1.5, 0.5))
    assert "roll" not in made


def test_drops_fall_from_several_heights_and_once_tilted():
    known, toy, rest, _ = object_bench()
    made = by_name(body_motions(known, "mujoco", tilted=False))
    assert [m.text for m in made["drop"]] == [
        f"drop block from {h} m above where it rests" for h in ("0.05", "0.2", "0.6")
    ]
    for motion, height in zip(made["drop"], (0.05, 0.2, 0.6), strict=True):
        np.testing.assert_allclose(motion.qpos, toy.pose(rest, np.array([0, 0, height]), np.zeros(3)))
        assert (motion.qvel == 0).all()
        assert motion.duration == pytest.approx(np.sqrt(2 * height / 9.81) + 0.6)
    (tilted,) = made["tilted drop"]
    assert tilted.text == "drop block from 0.2 m above where it rests, tilted by 30 deg about x"
    np.testing.assert_allclose(tilted.qpos, toy.pose(rest, np.array([0, 0, 0.2]), np.array([np.pi / 6, 0, 0])))
    assert tilted.duration == pytest.approx(np.sqrt(0.4 / 9.81) + 0.6)


def test_round_objects_roll_without_slipping():
    known, _, rest, v = object_bench(BALL)
    rolls = by_name(body_motions(known, "mujoco", tilted=False))["roll"]
    assert [m.text for m in rolls] == [f"roll block at {v:.2g} m/s", f"roll block at {0.5 * v:.2g} m/s"]
    turn = Rotation.from_quat(rest[12:16], scalar_first=True)
    for motion, speed in zip(rolls, (v, 0.5 * v), strict=True):
        np.testing.assert_allclose(motion.qvel[8:11], [speed, 0, 0], atol=1e-12)
        spin = turn.apply(motion.qvel[11:14])
        np.testing.assert_allclose(motion.qvel[8:11] + np.cross(spin, [0, 0, -0.02]), 0, atol=1e-9)
        assert motion.duration == 2.5


@pytest.mark.parametrize(
    ("shape", "direction"),
    [
        (BALL, [1, 0, 0]),
        ('type="capsule" size=".02 .03" euler="90 0 0"', [np.cos(YAW), np.sin(YAW), 0]),
        ('type="cylinder" size=".02 .03" euler="0 90 0"', [-np.sin(YAW), np.cos(YAW), 0]),
        ('type="cylinder" size=".02 .03" euler="85 0 0"', [np.cos(YAW), np.sin(YAW), 0]),
        ('type="cylinder" size=".02 .03" euler="83 0 0"', None),
        ('type="ellipsoid" size=".02 .02 .02"', None),
        (BOX, None),
    ],
)
def test_rolling_is_across_the_axis_of_what_lies(shape, direction):
    known = bench(shape)
    found = _roll(thrown(known), known.starts[1][0])
    if direction is None:
        assert found is None
        return
    assert found is not None
    assert abs(found[0] @ direction) == pytest.approx(1, abs=1e-6)
    assert found[1] == 0.02


def test_objects_of_several_colliding_shapes_do_not_roll():
    two = XML.format(shape=BALL).replace('name="block" type="sphere"', 'size=".01"/><geom type="sphere"')
    ghost = XML.format(shape=BALL).replace(
        '<geom name="block"', '<geom size=".01" contype="0" conaffinity="0"/><geom name="block"'
    )
    known = bench()
    for xml, rolls in ((two, False), (ghost, True)):
        toy = thrown(RecordedRange(Model(Scene(xml)), known.recording, known.noise))
        assert (_roll(toy, known.starts[0][0]) is not None) == rolls


def test_throws_are_like_the_fastest_recorded_one():
    known, _, _, _ = object_bench(lift=0.3)
    throws = by_name(body_motions(known, "mujoco", tilted=False))["throw"]
    qpos, qvel = known.starts[1]
    velocity = qvel[8:11]
    level, fast = velocity * [1, 1, 0], float(np.linalg.norm(velocity[:2]))
    spin = Rotation.from_quat(qpos[12:16], scalar_first=True).apply(qvel[11:14])
    up, still = np.array([0, 0, 1.0]), np.zeros(3)
    assert [m.text for m in throws] == [
        f"throw block as before but at {1.5 * fast:.2g} m/s",
        f"throw block as before but at {0.5 * fast:.2g} m/s",
        f"throw block at {fast:.2g} m/s the other way",
        "throw block as before, spinning at 10 rad/s about the vertical",
        "let block fall from where it was thrown",
        "throw block straight up at 1 m/s",
    ]
    launches = [1.5 * level, 0.5 * level, -level, level, still, up]
    turnings = [spin, spin, spin, 10 * up, still, still]
    for motion, launch, turning in zip(throws, launches, turnings, strict=True):
        np.testing.assert_allclose(motion.qvel[8:11], launch + velocity * up, atol=1e-12)
        turned = Rotation.from_quat(motion.qpos[12:16], scalar_first=True).apply(motion.qvel[11:14])
        np.testing.assert_allclose(turned, turning, atol=1e-12)
        np.testing.assert_array_equal(motion.qpos, qpos)
        assert motion.duration == pytest.approx(known.longest.duration)
    quick = by_name(body_motions(bench(lift=0.3, speed=5.0), "mujoco", tilted=False))["throw"]
    top = float(np.linalg.norm(bench(lift=0.3, speed=5.0).starts[1][1][8:10]))
    assert quick[5].text == f"throw block straight up at {top:.2g} m/s"
    assert top > 1
    low = by_name(body_motions(bench(lift=0.015), "mujoco", tilted=False))
    assert "throw" not in low


def test_objects_are_turned_or_heavier_while_commands_are_repeated():
    known, toy, _, _ = object_bench()
    made = by_name(body_motions(known, "mujoco", tilted=False))
    qpos, qvel = known.starts[1]
    turned = made["repeat with the turned object"]
    assert [m.text for m in turned] == [f"turn block by {d} deg and repeat the same commands" for d in (90, 180)]
    for motion, angle in zip(turned, (np.pi / 2, np.pi), strict=True):
        np.testing.assert_allclose(motion.qpos, toy.pose(qpos, np.zeros(3), np.array([0, 0, angle])))
        np.testing.assert_array_equal(motion.qvel, qvel)
        assert motion.duration == known.longest.duration
        assert motion.action is known.longest.action
    (heavy,) = made["repeat with payload"]
    assert heavy.text == f"with {payload_text(heavy.payloads)}, repeat the same commands"
    assert [(p.body, p.mass) for p in heavy.payloads] == [("block", pytest.approx(0.15))] * 2
    (first,), (spin,) = made["slide with payload"], made["spin in place with payload"]
    assert first.text.endswith(f", {made['slide'][0].text}")
    assert spin.text.endswith(f", {made['spin in place'][1].text}")
    assert first.payloads == heavy.payloads
    assert "slide, turned table" not in made
    (table,) = by_name(body_motions(known, "mujoco", tilted=True))["slide, turned table"]
    assert table.text.startswith("turn the table by 180 deg, so that its slope runs the other way, and push block off")
    assert table.change is slope_turned
    few = RecordedRange(known.model, known.recording, known.noise, replace(MotionMenuCfg(), max_bodies=0))
    assert list(body_motions(few, "mujoco", tilted=True)) == []


def test_recorded_ranges_are_those_of_all_demonstrations():
    known = bench()
    assert known.longest.name == "long"
    assert known.period["reach_position"] == pytest.approx(1.2 / 19)
    assert known.period["block_position"] == 0.01
    assert [known.m.body(b).name for b in known.bodies] == ["block"]
    assert known.channels(("block",)) == ["reach_position"]
    assert known.channels(()) == ["reach_position", "block_position", "block_orientation"]
    assert known.body_of("reach_position") == -1
    held = known.holding(known.longest)
    assert {n: c.value.tolist() for n, c in held.items()} == {"spare": [0.7], "reach": [0.1], "turn_drive": [0.0]}
    assert all(c.time.tolist() == [0.0] for c in held.values())
    site = XML.format(shape=BOX).replace('<geom name="block"', '<site name="s"/><geom name="block"')
    site = site.replace('objtype="xbody" objname="block"/>\n', 'objtype="site" objname="s"/>\n')
    other = RecordedRange(Model(Scene(site)), known.recording, known.noise)
    assert other.body_of("block_position") == other.m.body("block").id


def test_drives_are_position_drives_whose_commands_vary():
    found = Drives.of(bench())
    assert found is not None
    assert found.ids == (1, 2)
    np.testing.assert_allclose(found.first, [0.1, 0.0])
    np.testing.assert_allclose(found.low, [-0.05, 0.3 * min(np.sin(TIME))])
    np.testing.assert_allclose(found.high, [0.1 + 0.05 * TIME[-1] + 0.1, 0.3 * np.sin(TIME).max()])
    np.testing.assert_allclose(found.middle, (found.low + found.high) / 2)
    np.testing.assert_allclose(found.half, (found.high - found.low) / 2)
    assert found.speed[0] == pytest.approx(0.105 / 0.1, rel=0.02)
    assert found.speed[1] == pytest.approx(0.3 * np.sin(0.1) / 0.1, rel=0.02)
    assert found.slowest == pytest.approx(float((found.half / found.speed).max()))
    still = Drives.of(bench(turning=False))
    assert still is not None
    assert still.ids == (1,)


def test_top_speeds_are_means_over_a_window():
    time = np.arange(0, 1.0, 0.01)
    assert _top_speed(Channel(time, 0.3 * time), 0.1) == pytest.approx(0.3)
    step = np.where(time >= 0.5, 2.0, 0.0)
    assert _top_speed(Channel(time, step), 0.1) == pytest.approx(20.0)
    assert _top_speed(Channel(time, -step), 0.2) == pytest.approx(10.0)
    assert _top_speed(Channel(time[:1], step[:1]), 0.1) == 0.0


def drive_menu(known: RecordedRange, tilted: bool = False) -> dict[str, list[ProposedMotion]]:
    """Return the motions of drives by name."""
    return by_name(drive_motions(known, tilted))


def test_repeats_are_faster_and_slower_and_on_a_turned_base():
    known = bench()
    made = drive_menu(known, tilted=True)
    qpos, qvel = known.starts[1]
    repeats = made["repeat at another speed"]
    assert [m.text for m in repeats] == [
        "repeat the same commands faster, at 1.5 times the speed",
        "repeat the same commands slower, at 0.5 times the speed",
    ]
    for motion, scale in zip(repeats, (1.5, 0.5), strict=True):
        np.testing.assert_allclose(motion.action["reach"].time, TIME / scale)
        np.testing.assert_array_equal(motion.action["reach"].value, known.longest.action["reach"].value)
        assert motion.duration == pytest.approx(known.longest.duration / scale)
        np.testing.assert_array_equal(motion.qpos, qpos)
        np.testing.assert_array_equal(motion.qvel, qvel)
    (base,) = made["turned base"]
    assert base.text.startswith("turn the base on which everything stands by 180 deg, so that its slope runs the other")
    assert base.text.endswith("way, and repeat the same commands")
    assert base.change is slope_turned
    assert base.duration == known.longest.duration
    short = replace(MotionMenuCfg(), max_duration=1.0)
    limited = drive_menu(RecordedRange(known.model, known.recording, known.noise, short), tilted=True)
    assert {m.duration for m in limited["repeat at another speed"] + limited["turned base"]} == {1.0}
    assert "lighter grip" not in made


def in_units(motion: ProposedMotion, drives: Drives, k: int) -> np.ndarray:
    """Return the commands of a drive from its middle in units of half its range."""
    value = motion.action[("spare", "reach", "turn_drive")[drives.ids[k]]].value
    return (value - drives.middle[k]) / drives.half[k]


def expected_lead(drives: Drives, k: int, first: float) -> np.ndarray:
    """Return how commands begin: from the recorded first ones to the first of the motion, in units of the range."""
    entry = (drives.first - drives.middle) / drives.half
    count = max(int(max(drives.slowest * np.abs(entry - first).max(), 0.3) * 100), 2)
    return np.linspace(entry[k], first, count)


def test_trajectories_of_drives_have_their_parts_in_units_of_their_ranges():
    known = bench()
    drives = Drives.of(known)
    assert drives is not None
    made, quick = drive_menu(known), drives.slowest

    def ramp(a, b, seconds):
        return np.linspace(a, b, max(int(seconds * 100), 2))

    sweeps = [ramp(a, b, min(2 * quick / p, 4.0)) for a, b, p in ((-1, 1, 0.1), (1, -1, 0.4), (-1, 1, 1.0))]
    slow = 0.3 * quick / 0.1
    reversals = [ramp(-0.15, 0.15, slow), ramp(0.15, -0.15, slow)] * 2
    top = float(np.clip(1 / (2 * np.pi * 0.3 * quick), 1.0, 8.0))
    time = np.arange(0, 6, 0.01)
    chirp = [0.3 * np.sin(2 * np.pi * (0.3 * time + (top - 0.3) * time**2 / 12))]
    steps = [np.full(60, x) for x in (0, 0.4, -0.4, 0.2, -0.2, 0)]
    holds, here = [], -1.0
    for place in (-1, -0.5, 0, 0.5, 1):
        holds += [ramp(here, place, max(quick, 0.4)), np.full(70, place)]
        here = place
    texts = {
        "sweeps": "sweep all drives together over their ranges at 0.1, 0.4, 1 times the highest speed",
        "slow reversals": "move all drives together to and fro slowly over 15 % of the range",
        "chirp": f"swing all drives together over 30 % of the range with a rising frequency, 0.3 to {top:.1f} Hz",
        "steps": "command steps of up to 40 % of the range to all drives together",
        "holds": "hold all drives together in five poses across the range",
    }
    for name, parts in zip(texts, (sweeps, reversals, chirp, steps, holds), strict=True):
        (motion,), whole = made[name], np.zeros(0)
        assert motion.text == f"{texts[name]}, with block out of the way"
        for k in range(2):
            whole = np.concatenate([expected_lead(drives, k, parts[0][0]), *parts])[:800]
            np.testing.assert_allclose(in_units(motion, drives, k), whole, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(motion.action["reach"].time, np.arange(len(whole)) / 100)
        assert motion.duration == pytest.approx(len(whole) / 100)
        assert motion.action["spare"].value.tolist() == [0.7]
        assert motion.away == ("block",)
        start = known.starts[1][0].copy()
        start[9] += 5.0
        np.testing.assert_array_equal(motion.qpos, start)
        assert (motion.qvel == 0).all()


def test_a_single_drive_is_reported_with_its_range_and_speeds():
    known = bench(turning=False)
    drives = Drives.of(known)
    assert drives is not None
    (sweep,) = drive_menu(known)["sweeps"]
    speeds = ", ".join(f"{p * drives.speed[0]:.2g}" for p in (0.1, 0.4, 1.0))
    assert sweep.text == f"sweep reach between -0.05 and 0.3 m at {speeds} m/s, with block out of the way"
    only = XML.format(shape=BOX)
    swapped = bench()
    (d,) = swapped.recording.demonstrations[1:]
    fixed = replace(d, action={**d.action, "reach": Channel(TIME, 0 * TIME)})
    turned = RecordedRange(
        Model(Scene(only)), replace(swapped.recording, demonstrations=(fixed,)), {"reach_position": 1e-4}
    )
    (sweep,) = drive_menu(turned)["sweeps"]
    assert sweep.text.startswith("sweep turn drive between ")
    assert " rad at " in sweep.text
    assert sweep.text.endswith(" rad/s")


def test_payloads_are_put_on_the_last_link_that_the_drives_carry():
    known = bench()
    drives = Drives.of(known)
    assert drives is not None
    assert payload_links(known, drives.ids) == ["hand"]
    hand, rail = known.m.body("hand").id, known.m.body("rail").id
    assert _above(known.m, hand) == {0, rail, hand}
    assert payload_links(known, (2,)) == ["hand"]
    made = drive_menu(known)
    heavy = {name for name in made if name.endswith("with payload")}
    assert heavy == {f"{n} with payload" for n in ("sweeps", "slow reversals", "chirp", "holds")}
    (sweep,) = made["sweeps with payload"]
    (payload,) = sweep.payloads
    assert sweep.text == f"with {payload_text((payload,))}, {made['sweeps'][0].text}"
    assert (payload.body, payload.mass) == ("hand", pytest.approx(0.2))
    assert payload.position == pytest.approx(tuple(known.m.body_ipos[hand]), abs=1e-3)


def test_scenes_without_actuators_have_no_motions_of_drives():
    known = bench()
    xml = XML.format(shape=BOX)
    bare = xml[: xml.index("<actuator>")] + xml[xml.index("<sensor>") :]
    idle = tuple(replace(d, action={}) for d in known.recording.demonstrations)
    loose = RecordedRange(Model(Scene(bare)), replace(known.recording, demonstrations=idle), known.noise)
    assert list(drive_motions(loose, tilted=True)) == []
    names = set(by_name(body_motions(loose, "mujoco", tilted=False)))
    assert "slide" in names
    assert "repeat with payload" not in names
