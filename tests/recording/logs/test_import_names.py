"""Channels are matched by the words of their names in any order, and by order where as many are left as actuators."""

import pytest

from concent_warp.cli import main
from concent_warp.recording.logs.suggest import suggest_map

ARM = """<mujoco><worldbody><body><joint name="{a}" axis="0 1 0"/><geom size="0.1"/>
<body><joint name="{b}" axis="0 1 0"/><geom size="0.1"/></body></body></worldbody>
<actuator>{actuators}</actuator>
<sensor><jointpos name="{a}_q" joint="{a}"/><jointpos name="{b}_q" joint="{b}"/></sensor></mujoco>"""
MOTOR = '<motor name="force" joint="shoulder"/>'
SERVO = '<position name="force" joint="shoulder" kp="2"/>'


def suggested(place, columns: str, actuators: str = "", a: str = "shoulder", b: str = "elbow") -> str:
    (place / "arm.xml").write_text(ARM.format(a=a, b=b, actuators=actuators))
    count = columns.count(",") + 1
    rows = [",".join([f"{0.01 * t:.2f}", *[f"{0.001 * t + 0.1 * k:.4f}" for k in range(count)]]) for t in range(50)]
    (place / "log.csv").write_text("\n".join([f"t,{columns}", *rows]))
    return suggest_map(place / "log.csv", place / "arm.xml")


def test_the_same_words_in_another_order_match(tmp_path):
    text = suggested(tmp_path, "q_elbow,q_shoulder,q_wrist")
    assert '[measured.shoulder_q]\nsource = "q_shoulder"\n' in text
    assert '[measured.elbow_q]\nsource = "q_elbow"\n' in text


def test_words_in_another_order_match_only_where_nothing_else_has_them(tmp_path):
    text = suggested(tmp_path, "finger_2_1,finger_1_2,other", a="finger_1_2", b="finger_2_1")
    assert '[measured.finger_1_2_q]\nsource = "finger_1_2"\n' in text
    assert '[measured.finger_2_1_q]\nsource = "finger_2_1"\n' in text
    text = suggested(tmp_path, "q_elbow_left,left_q_elbow,other", a="elbow_left", b="wrist")
    assert "# [measured.elbow_left_q]  # no channel found" in text


@pytest.mark.parametrize("column", ["motor_N", "u", "drive_input"])
def test_the_one_channel_that_is_left_is_suggested_for_the_one_actuator(tmp_path, column):
    text = suggested(tmp_path, f"{column},shoulder_q,elbow_q", MOTOR.replace("shoulder", "elbow"))
    assert f'[action.force]  # guess: by order, no name says command\nsource = "{column}"\n' in text


@pytest.mark.parametrize(
    ("columns", "actuator"),
    [
        ("u,v,shoulder_q,elbow_q", MOTOR),
        ("angle,shoulder_q,elbow_q", MOTOR),
        ("u,shoulder_q", MOTOR),
        ("speed_rpm,shoulder_q,elbow_q", MOTOR),
        ("motor_torque,shoulder_q,elbow_q", SERVO),
        ("tip_x,shoulder_q,elbow_q", SERVO),
    ],
)
def test_channels_that_may_be_of_other_things_are_not_suggested_for_an_actuator(tmp_path, columns, actuator):
    assert "# [action.force]  # no channel found" in suggested(tmp_path, columns, actuator)


def test_a_dry_run_names_the_sensors_without_a_channel(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    suggested(tmp_path, "shoulder_q,elbow_q,tip")
    command = ["import", "log.csv", "--model", "arm.xml", "--map", "map.toml", "--dry-run"]
    last = "leave out --dry-run and add -o demo.h5 to import it\n"
    for entries, said in (
        ('shoulder_q = "shoulder_q"\nelbow_q = "elbow_q"', "nothing is wrong"),
        (
            'shoulder_q = "shoulder_q"',
            "nothing is wrong, but no channel is mapped to sensor 'elbow_q' of the scene: "
            "if the log has it, add it to the map",
        ),
    ):
        (tmp_path / "map.toml").write_text(f"[measured]\n{entries}\n")
        assert main(command) == 0
        assert f"{said}; {last}" in capsys.readouterr().out
    model = tmp_path / "arm.xml"
    more = "".join(f'<jointvel name="v{k}" joint="elbow"/>' for k in range(9))
    model.write_text(model.read_text().replace("</sensor>", f"{more}</sensor>"))
    assert main(command) == 0
    named = (
        "no channel is mapped to sensors 'elbow_q', 'v0', 'v1', 'v2', 'v3', 'v4', 'v5', 'v6' and 2 more of the scene"
    )
    assert named in capsys.readouterr().out
