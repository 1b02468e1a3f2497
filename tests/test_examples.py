"""The examples run as they stand, and do what they say."""

from __future__ import annotations

import json
import re
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import pytest

import concent_warp as cw
from concent_warp.cli.terminal import quiet_warp
from concent_warp.events.sequence import ContactEventSequence


@pytest.fixture
def run(root: Path, capsys, monkeypatch) -> Callable[..., str]:
    """Return a function that runs an example as a script, in this process, and returns what it prints."""

    def run(name: str, *arguments: object) -> str:
        path = root / "examples" / name
        monkeypatch.setattr(sys, "argv", [str(path), *map(str, arguments)])
        monkeypatch.syspath_prepend(path.parent)
        quiet_warp()
        capsys.readouterr()
        runpy.run_path(str(path), run_name="__main__")
        return capsys.readouterr().out

    return run


def errors(said: str) -> dict[str, list[float]]:
    """Return the multiples of the noise that are printed for each channel."""
    found = re.findall(r"^(\w+): (?:([\d.]+) -> )?([\d.]+) x noise", said, re.MULTILINE)
    return {channel: [float(value) for value in values if value] for channel, *values in found}


def test_own_robot_is_fitted_staged_and_read_back(run, tmp_path):
    said = run("own_robot.py", tmp_path)
    losses = [float(line.split()[2]) for line in said.splitlines() if line.startswith("generation")]
    assert losses[-1] < 0.8 * losses[0]
    events = ContactEventSequence.load(tmp_path / "events.json")
    assert [stage.name for stage in events.stages][:2] == ["pick", "align"]
    assert cw.load_model(tmp_path / "model.toml").geometry is not None
    listed = run("steps/load_recording.py", tmp_path / "gantry.h5")
    assert "measured/block_position: 540 samples, 200 Hz, 0 % missing" in listed


def test_object_from_mesh_rests_on_its_spheres_in_plain_mujoco_too(run, tmp_path):
    assert "to rest at 6.0 mm" in run("objects_from_mesh.py", tmp_path)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "ring_with_spheres.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=500)
    assert data.body("ring").xpos[2] == pytest.approx(0.006, abs=2e-4)


def test_tool_of_an_arm_of_six_joints_is_found_to_weigh_twice_as_much(run):
    said = run("robots/six_joint_arm.py")
    assert min(value for (value,) in errors(said).values()) > 2
    (factor,) = re.findall(r"^mass of tool: ([\d.]+) x the model's$", said, re.MULTILINE)
    assert float(factor) == pytest.approx(2.0, rel=0.01)


def test_planar_arm_lacks_a_torque_at_the_elbow_alone_and_it_is_damping(run):
    said = run("robots/planar_arm.py")
    assert "elbow: lacks a torque\nshoulder: complete\n" in said
    (damping,) = re.findall(r"Missing: joint_damping \(.*damping\[elbow\] ([\d.]+) ", said)
    assert float(damping) == pytest.approx(0.4, rel=0.01)


def test_leg_finds_how_soft_its_contact_is(run):
    said = run("robots/leg.py")
    (time_constant,) = re.findall(r"time_constant = ([\d.]+) ", said)
    assert float(time_constant) == pytest.approx(0.025, rel=0.02)
    assert all(before > 5 and after < 1.1 for before, after in errors(said).values())
    assert len(errors(said)) == 3


def test_recording_that_comes_with_the_package_is_listed(run):
    assert "measured/hinge_position: 800 samples, 200 Hz, 0 % missing" in run("steps/load_recording.py")


def test_the_block_is_tracked_as_it_is_lifted(run):
    said = run("steps/track_objects.py", "--seconds", 3, "--rate", 4)
    ((moved, error),) = re.findall(r"^block: moved by ([\d.]+) cm, error ([\d.]+) mm$", said, re.M)
    assert float(moved) > 3
    assert float(error) < 0.5


def test_fit_writes_a_model_whose_replay_is_nearer_to_the_recording(run, tmp_path):
    said = run("steps/fit_geometry.py", "--generations", 3, "--spheres", 64, "--out", tmp_path)
    ((before, after),) = re.findall(r"^block position: ([\d.]+) -> ([\d.]+) mm", said, re.MULTILINE)
    assert float(after) < float(before)
    geometry = cw.load_model(tmp_path / "model.toml").geometry
    assert geometry is not None
    assert len(geometry) == 64


def test_events_are_the_three_stages_of_the_task(run, tmp_path):
    said = run("steps/extract_events.py", "--out", tmp_path)
    assert re.findall(r"^(\w+): .* s, (.*)$", said, re.MULTILINE) == [
        ("pick", "robot and block"),
        ("align", "block and box"),
        ("insert", "block and box"),
    ]
    assert (tmp_path / "events.json").is_file()
    assert (tmp_path / "schedule.png").is_file()


def test_comparison_falls_to_the_noise_with_friction(run):
    said = run("steps/compare.py")
    assert re.search(r"^hinge_position, nominal: .* 7\.2 x noise$", said, re.MULTILINE)
    assert re.search(r"^hinge_position, with friction: .* 1\.0 x noise$", said, re.MULTILINE)
    assert "hinge_position: the error has fallen" in said


def test_diagnosis_adds_joint_friction(run, tmp_path):
    assert "Missing: joint_friction (torque[hinge] 0.0298" in run("steps/diagnose.py", "--out", tmp_path)
    assert [with_values.effect.name for with_values in cw.load_model(tmp_path / "model.toml").effects] == [
        "joint_friction"
    ]


def test_training_writes_a_policy(run, tmp_path):
    said = run("steps/train.py", "--iterations", 1, "--worlds", 2, "--steps", 2, "--out", tmp_path / "run")
    assert "iteration 1: 4 steps" in said
    assert cw.load_policy(tmp_path / "run").weights["iteration"] == 1


def test_pretrained_policy_succeeds_in_both_worlds(run):
    said = run("steps/evaluate.py", "--episodes", 2)
    assert "simulation: 100 % of 2" in said
    assert "reality: 100 % of 2" in said


def test_rendered_data_set_has_an_episode_of_both_cameras(run, tmp_path):
    said = run("steps/render.py", "--episodes", 1, "--size", 32, "--out", tmp_path / "dataset")
    assert said.startswith("1 episodes")
    info = json.loads((tmp_path / "dataset" / "meta" / "info.json").read_text())
    assert sorted(name for name in info["features"] if name.startswith("observation.images.")) == [
        "observation.images.base",
        "observation.images.wrist",
    ]


def test_report_names_what_was_missing(run, tmp_path):
    run("steps/write_report.py", "--out", tmp_path / "report.html")
    assert (
        '<div class="effect accepted"><span class="name">joint friction</span>'
        in (tmp_path / "report.html").read_text()
    )


def test_every_example_is_run_here_and_listed_in_the_documentation(root):
    here, listed = Path(__file__).read_text(), (root / "docs" / "examples.md").read_text()
    for path in (root / "examples").rglob("*.py"):
        name = path.relative_to(root / "examples").as_posix()
        if 'if __name__ == "__main__"' not in path.read_text():
            continue
        assert f"(../examples/{name})" in listed, name
        assert f'"{name}"' in here or name.startswith("hidden_effect/"), name
