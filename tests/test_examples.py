"""The examples run as they stand, and do what they say."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import mujoco
import pytest

from concent_warp.events.sequence import ContactEventSequence
from concent_warp.model import Model


@pytest.fixture
def run(root: Path):
    """Return a function that runs an example and returns what it prints."""

    def run(name: str, *arguments: Path) -> str:
        command = [sys.executable, root / "examples" / name, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_own_robot_is_fitted_staged_and_read_back(run, tmp_path):
    said = run("own_robot.py", tmp_path)
    losses = [float(line.split()[2]) for line in said.splitlines() if line.startswith("generation")]
    assert losses[-1] < 0.8 * losses[0]
    events = ContactEventSequence.load(tmp_path / "events.json")
    assert [stage.name for stage in events.stages][:2] == ["pick", "align"]
    assert Model.load(tmp_path / "model.toml").geometry is not None
    listed = run("read_recording.py", tmp_path / "gantry.h5")
    assert "measured/block_position: 540 samples, 200 Hz, 0 % missing" in listed


def test_object_from_mesh_rests_on_its_spheres_in_plain_mujoco_too(run, tmp_path):
    assert "to rest at 6.0 mm" in run("objects_from_mesh.py", tmp_path)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "ring_with_spheres.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=500)
    assert data.body("ring").xpos[2] == pytest.approx(0.006, abs=2e-4)


def test_every_example_is_run_here(root):
    here = Path(__file__).read_text()
    assert all(f'"{path.name}"' in here for path in (root / "examples").glob("*.py"))
