from dataclasses import replace

import numpy as np
import pytest

from concent_warp.diagnosis import tasks as task_module
from concent_warp.diagnosis.candidates.baseline import fit_baseline
from concent_warp.diagnosis.candidates.candidate import ScreenedCandidate
from concent_warp.diagnosis.candidates.growing_windows import baseline_of_first_parts
from concent_warp.diagnosis.cfg import DiagnoseCfg, ProfileLikelihoodCfg, SearchCfg
from concent_warp.diagnosis.checkpoint import _load, _save, checkpointed_runner
from concent_warp.diagnosis.diagnose import diagnose
from concent_warp.diagnosis.search import context
from concent_warp.effects.registry import effect_class
from concent_warp.errors import ConcentError
from concent_warp.fit.effects.cross_validation import cut_blocks
from concent_warp.fit.effects.observe import observe
from tests.diagnosis.same_results import assert_same
from tests.scenes.swinging import drawing, swung

CFG = DiagnoseCfg(effects=("joint_damping", "armature"), jobs=1, explain=False, search=SearchCfg(far_ratio=1e6))


@pytest.fixture(scope="module")
def recording():
    return swung(seconds=1.0)


@pytest.fixture(scope="module")
def done(recording, tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoint") / "new"
    return folder, diagnose(drawing(recording), recording, CFG, out=folder)


def counted(monkeypatch):
    """Count the pieces of work that are done and not read."""
    tasks = []
    run_tasks = task_module.run_tasks_in_time

    def watched(work, given, jobs):
        tasks.extend(work.__name__ for _ in given)
        return run_tasks(work, given, jobs)

    monkeypatch.setattr(task_module, "run_tasks_in_time", watched)
    monkeypatch.setattr(context, "run_tasks", watched)
    return tasks


def test_a_second_run_reads_every_piece_and_ends_the_same(recording, done, monkeypatch):
    folder, first = done
    tasks = counted(monkeypatch)
    again = diagnose(drawing(recording), recording, CFG, out=folder)
    assert tasks == []
    assert_same(again.to_json(), first.to_json())
    assert [a.values for a in again.model.effects] == [a.values for a in first.model.effects]


def test_an_interrupted_run_goes_on_to_the_same_end(recording, done, tmp_path, monkeypatch):
    class Stop(Exception):  # noqa: N818
        pass

    def stop(_, text):
        if text.startswith("fitting, 1"):
            raise Stop

    with pytest.raises(Stop):
        diagnose(drawing(recording), recording, CFG, out=tmp_path, progress=stop)
    kept = len(list(tmp_path.glob("*.npz")))
    assert kept >= 3
    tasks = counted(monkeypatch)
    again = diagnose(drawing(recording), recording, CFG, out=tmp_path)
    assert len([t for t in tasks if t != "refit_without_effect"]) == len(list(done[0].glob("*.npz"))) - kept
    assert_same(again.to_json(), done[1].to_json())


def test_damaged_pieces_are_done_again(recording, done, monkeypatch):
    folder, first = done
    pieces = sorted(folder.glob("*.npz"))
    pieces[0].write_bytes(b"nothing")
    pieces[1].write_bytes(pieces[1].read_bytes()[:200])
    tasks = counted(monkeypatch)
    again = diagnose(drawing(recording), recording, CFG, out=folder)
    assert len(tasks) == 2
    assert_same(again.to_json(), first.to_json())


@pytest.mark.parametrize("other", ["seed", "threshold", "data", "model"])
def test_pieces_of_another_diagnosis_are_not_taken(other, recording, done, monkeypatch):
    folder, _ = done
    cfg, model, used = CFG, drawing(recording), recording
    if other == "seed":
        cfg = replace(CFG, seed=1)
    elif other == "threshold":
        cfg = replace(CFG, profile=ProfileLikelihoodCfg(max_restarts=2))
    elif other == "data":
        used = swung(seconds=1.0, seed=1)
    else:
        model = model.add(effect_class("joint_friction")("hinge"))
    before = len(list(folder.glob("*.npz")))
    tasks = counted(monkeypatch)
    diagnose(model, used, cfg, out=folder)
    assert tasks
    assert len(list(folder.glob("*.npz"))) == before + len(tasks)


def test_saved_results_are_restored_unchanged(recording, tmp_path):
    effect = effect_class("joint_damping")("hinge")
    kept = ScreenedCandidate(effect, 0.5, float("-inf"), np.array([1.0, np.inf]), (), measured=True)
    _save(tmp_path / "a.npz", kept)
    found = _load(tmp_path / "a.npz", drawing(recording))
    assert (found.effect.name, found.effect.target) == ("joint_damping", ("hinge",))
    assert (found.linear_gain, found.scanned_gain, found.pieces, found.measured) == (0.5, float("-inf"), (), True)
    assert found.start.tolist() == [1.0, np.inf]
    assert _load(tmp_path / "b.npz", drawing(recording)) is None
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


def test_a_model_over_the_first_parts_of_windows_is_found_anew(recording, tmp_path):
    model = drawing(recording)
    windows = observe(model, recording)
    base = fit_baseline(model, windows, cut_blocks(windows))
    runner = checkpointed_runner(model, recording, CFG, lambda *_: None, "mujoco", tmp_path)
    for _ in range(2):
        (near,) = runner.results(baseline_of_first_parts, [(base, 0.3)])
        assert near is not None
        assert near.windows[0].end == pytest.approx(near.windows[0].start + 0.3)
    assert not list(tmp_path.glob("*.npz"))


def test_a_folder_that_cannot_be_made_is_an_error(recording, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConcentError, match="cannot be made"):
        diagnose(drawing(recording), recording, CFG, out=tmp_path / "file" / "folder")
