"""One drive of two is weak: a limit of both alike would stop the stronger one, too."""

import mujoco
import numpy as np
import pytest

import concent_warp as cw
from concent_warp.diagnosis.candidates import screening
from concent_warp.diagnosis.candidates.candidates import candidates
from concent_warp.model import Model
from concent_warp.recording.recording import Channel, Demonstration, Recording
from concent_warp.scene.scene import Scene

GANTRY = """<mujoco><option timestep="0.004" integrator="implicitfast"/><worldbody>
<body><joint name="x" type="slide" axis="1 0 0" damping="20"/><geom size=".1" mass="5" contype="0" conaffinity="0"/>
<body><joint name="y" type="slide" axis="0 1 0" damping="10"/><geom size=".1" mass="1" contype="0" conaffinity="0"/>
</body></body></worldbody>
<actuator><position name="along" joint="x" kp="2000" kv="150"/><position name="across" joint="y" kp="500" kv="40"/>
</actuator><sensor><jointpos name="x" joint="x"/><jointpos name="y" joint="y"/></sensor></mujoco>"""
LIMIT, STEP = 6.0, 0.02
DRIVES = (("along", "across"), ("along",), ("across",))


def gantry():
    return Model(Scene(GANTRY))


def recording():
    time = np.arange(0, 4, STEP)
    targets = np.stack([0.3 * np.sin(5 * time), 0.1 * np.sin(3 * time) + 0.1 * np.sin(7 * time)], axis=1)
    m = mujoco.MjModel.from_xml_string(GANTRY)
    m.actuator_forcelimited[1], m.actuator_forcerange[1] = 1, (-LIMIT, LIMIT)
    d, rng, rows = mujoco.MjData(m), np.random.default_rng(0), []
    for target in targets:
        rows.append(d.qpos.copy())
        d.ctrl[:] = target
        mujoco.mj_step(m, d, round(STEP / m.opt.timestep))
    value = np.array(rows) + rng.normal(0, 1e-4, (len(time), 2))
    action = {name: Channel(time, targets[:, k]) for k, name in enumerate(DRIVES[0])}
    measured = {name: Channel(time, value[:, [k]], 1e-4) for k, name in enumerate("xy")}
    return Recording(GANTRY, (Demonstration("demo_0", action=action, measured=measured),))


@pytest.mark.parametrize("name", ["actuator_saturation", "backlash"])
def test_what_has_one_value_for_all_drives_is_tried_on_each_alone(name):
    found = [e.target for e in candidates(gantry(), {"x", "y"}, [name])]
    assert found == list(DRIVES)
    assert [e.target for e in candidates(gantry().add_effect(name, ["across"]), {"x", "y"}, [name])] == [("along",)]
    assert len(gantry().add_effect(name).effects) == 1


def named(data):
    cfg = cw.DiagnoseCfg(effects=("actuator_saturation",), jobs=1, max_additions=1, explain=False)
    return cw.diagnose(gantry(), data, cfg)


def test_the_weak_drive_is_named_with_its_limit():
    found = named(recording())
    assert (found.verdict, found.groups) == ("effect", (("actuator_saturation(across)",),))
    assert found.accepted[0].parameters[0].value == pytest.approx(LIMIT, rel=0.02)


@pytest.mark.parametrize("reached", [0, 1, 20, 35])
def test_limits_that_no_drive_reaches_are_found_without_a_simulation_of_each(reached):
    tried = []

    def left(values):
        tried.append(values)
        return 5.0 if values[0] < reached else 5.0 - 0.1 * values[0]

    assert screening._idle([np.array([k]) for k in range(36)], left) == max(reached - 1, 0)
    assert len(tried) <= 7
    assert screening._idle([], left) == screening._idle([np.zeros(1)], left) == 0


def test_an_effect_on_all_drives_is_not_named_where_that_on_one_explains_as_much():
    rng, idle = np.random.default_rng(0), recording()
    demonstration = idle.demonstrations[0]
    time = demonstration.action["along"].time
    still = {**demonstration.action, "along": Channel(time, np.zeros(len(time)))}
    x = Channel(time, rng.normal(0, 1e-4, (len(time), 1)), 1e-4)
    quiet = Demonstration("demo_0", action=still, measured={**demonstration.measured, "x": x})
    assert named(Recording(GANTRY, (quiet,))).groups == (("actuator_saturation(across)",),)


def test_a_limit_that_shows_between_two_scanned_values_only_is_found():
    # Just below the limit too much is cut off; above it the effect fades soon.
    def left(values):
        return 10 * (1 + 500 * max(LIMIT - values[0], 0) - 0.4 * max(1 - abs(values[0] / LIMIT - 1) / 0.2, 0))

    line = [np.array([v]) for v in LIMIT * 1.08 * np.geomspace(1.4, 0.7, 5)]
    scanned = [left(v) for v in line]
    k = int(np.argmin(scanned))
    best, least = screening._between(line, k, scanned[k], left, cw.DiagnoseCfg().search.limit_halvings)
    assert best[0] == pytest.approx(LIMIT, rel=0.01)
    assert least == left(best) < 0.85 * scanned[k]
    assert line[k][0] / LIMIT > 1.05
    assert screening._between(line[:1], 0, scanned[0], left, 4) == (line[0], scanned[0])
