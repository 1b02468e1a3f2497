import pytest


def test_models_made_with_something_else_hidden_are_not_taken(script, tmp_path):
    cases = script("benchmarks.train.cases")
    folder = tmp_path / "models" / cases.CASES["aware"].material(6)
    folder.mkdir(parents=True)
    cases.same_world(tmp_path, ["aware"], [6], "actuator_delay=0.1")
    (folder / cases.WORLD).write_text("joint_compliance=0.004")
    cases.same_world(tmp_path, ["aware"], [6], "joint_compliance=0.004")
    cases.same_world(tmp_path, ["ours"], [6], "actuator_delay=0.1")
    with pytest.raises(SystemExit, match=r"made with joint_compliance=0\.004 hidden, not actuator_delay=0\.1"):
        cases.same_world(tmp_path, ["ours", "aware"], [5, 6], "actuator_delay=0.1")
