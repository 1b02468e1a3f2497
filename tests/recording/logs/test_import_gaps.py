"""What a scene lacks for a log is said with lines to add, and an import without measurements is refused."""

import pytest

from concent_warp.cli import main
from concent_warp.recording.load import load_recording
from concent_warp.recording.logs.scene_gaps import measured_gaps, unread_joints
from concent_warp.recording.logs.suggest import suggest_map
from concent_warp.scene.scene import Scene

ACTUATORS = '<position name="shoulder" joint="shoulder" kp="8"/><position name="elbow" joint="elbow" kp="4"/>'
SHOULDER = '<jointpos name="shoulder_position" joint="shoulder"/>'
ELBOW = '<jointpos name="elbow_position" joint="elbow"/>'
COMMAND = ["import", "log.csv", "--model", "arm.xml", "--map", "map.toml"]


def arm(actuators: str = ACTUATORS, sensors: str = SHOULDER + ELBOW, more: str = "") -> str:
    """Return the MJCF of an arm with two joints."""
    return f"""<mujoco><worldbody><body name="upper"><joint name="shoulder" axis="0 1 0"/><geom size="0.1" mass="1"/>
<body name="fore" pos="0.3 0 0"><joint name="elbow" axis="0 1 0"/><geom size="0.1" mass="1"/></body></body>{more}
</worldbody><actuator>{actuators}</actuator><sensor>{sensors}</sensor></mujoco>"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rows = [f"{0.01 * k:.2f},{0.001 * k},{0.002 * k},{0.001 * k},{0.002 * k}" for k in range(100)]
    (tmp_path / "log.csv").write_text("\n".join(["t,shoulder_cmd,elbow_cmd,shoulder_enc,elbow_enc", *rows]))
    return tmp_path


def test_actuators_and_sensors_without_names_are_said_with_the_names_to_write(place, capsys):
    nameless = ACTUATORS.replace('name="shoulder" ', "").replace('name="elbow" ', "")
    unnamed = '<jointpos joint="shoulder"/><jointvel joint="elbow"/>'
    (place / "arm.xml").write_text(arm(nameless, unnamed))
    assert main([*COMMAND, "--suggest"]) == 0
    said, text = capsys.readouterr().out, (place / "map.toml").read_text()
    for sentence in (
        "2 actuators of the scene have no names by which the map could call them; "
        "add name=\"shoulder\" to that of joint 'shoulder', name=\"elbow\" to that of joint 'elbow'",
        "2 sensors of the scene have no names by which the map could call them; "
        f'write {SHOULDER} <jointvel name="elbow_velocity" joint="elbow"/>',
    ):
        assert f"to mend in the MJCF: {sentence}\n" in said
        assert f"\n# scene: {sentence}\n" in text
    assert "\n3 guesses or gaps are marked" in said
    (place / "map.toml").write_text('[action]\nshoulder = "shoulder_cmd"\n')
    assert main([*COMMAND, "--dry-run"]) == 2
    assert "2 actuators of the scene have no names" in capsys.readouterr().out


def test_a_scene_without_sensors_is_said_with_those_to_add(place, capsys):
    (place / "arm.xml").write_text(arm(sensors=""))
    sentence = (
        f"the scene has no sensor that a measurement could be mapped to; add to its MJCF <sensor>{SHOULDER} {ELBOW}"
    )
    assert main([*COMMAND, "--suggest"]) == 0
    assert f"to mend in the MJCF: {sentence}</sensor>\n1 guesses or gaps" in capsys.readouterr().out
    for option in (["--dry-run"], ["-o", "demo.h5"]):
        assert main([*COMMAND, *option]) == 2
        out, err = capsys.readouterr()
        assert f"concent import: map.toml: the map names no measurement; {sentence}</sensor>." in err
        assert "nothing is wrong" not in out
    assert not (place / "demo.h5").exists()


def test_the_lines_for_a_scene_without_sensors_can_be_pasted(place, capsys):
    (line,) = measured_gaps(Scene(arm(sensors="")))
    (place / "arm.xml").write_text(arm(sensors=line.partition("<sensor>")[2].partition("</sensor>")[0]))
    assert main([*COMMAND, "--suggest"]) == 0
    assert "\n0 guesses or gaps" in f"\n{capsys.readouterr().out}"
    assert main([*COMMAND, "-o", "demo.h5"]) == 0
    assert sorted(load_recording("demo.h5")[0].measured) == ["elbow_position", "shoulder_position"]


def test_an_import_without_measurements_names_the_sensors_that_could_be_mapped(place, capsys):
    (place / "arm.xml").write_text(arm())
    (place / "map.toml").write_text('[action]\nshoulder = "shoulder_cmd"\nelbow = "elbow_cmd"\n')
    assert main([*COMMAND, "-o", "demo.h5"]) == 2
    said = "the map names no measurement; map a channel of the log to one of ['shoulder_position', 'elbow_position']"
    assert said in capsys.readouterr().err


def test_joints_that_channels_resemble_and_no_sensor_reads_are_said(place):
    (place / "arm.xml").write_text(arm(sensors=SHOULDER))
    text = suggest_map("log.csv", "arm.xml")
    assert f"reads the position of 'elbow', which channels of the log may be of; add to its <sensor> {ELBOW}\n" in text
    assert '[measured.shoulder_position]\nsource = "shoulder_enc"\n' in text
    log = (place / "log.csv").read_text()
    for other in ("elbow_torque", "wrist", "elbow_target"):
        (place / "log.csv").write_text(log.replace("elbow_enc", other))
        assert "# scene" not in suggest_map("log.csv", "arm.xml"), other


def test_a_scene_with_all_that_the_log_has_lacks_nothing(place):
    (place / "arm.xml").write_text(arm())
    assert "# scene" not in suggest_map("log.csv", "arm.xml")


def test_free_bodies_are_given_sensors_of_their_pose_and_many_lines_are_cut():
    block = '<body name="block"><freejoint/><geom size="0.1"/></body>'
    pose = '<framepos name="block_position" objtype="xbody" objname="block"/> <framequat name="block_orientation"'
    (said,) = measured_gaps(Scene(arm(sensors="", more=block)))
    assert f"{SHOULDER} {ELBOW} {pose}" in said
    many = "".join(f'<body><joint name="finger_{k}"/><geom size="0.1"/></body>' for k in range(5))
    (said,) = measured_gaps(Scene(arm(sensors="", more=many)))
    assert said.count("<jointpos") == 4
    assert " and 3 more alike</sensor>" in said


def test_a_joint_is_read_by_the_position_of_its_drive_and_one_without_a_name_cannot_be():
    scene = arm(sensors='<actuatorpos name="a" actuator="elbow"/><jointvel name="v" joint="shoulder"/>')
    assert unread_joints(Scene(scene)) == ["shoulder"]
    assert unread_joints(Scene(arm(more='<body><joint/><geom size="0.1"/></body>'))) == []
