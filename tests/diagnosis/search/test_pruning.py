from dataclasses import replace

import pytest

from concent_warp.diagnosis.candidates.baseline import add_candidate, fit_baseline, refit_without_effect, without_effect
from concent_warp.diagnosis.candidates.fit_candidate import fit_candidate, polish_candidate
from concent_warp.diagnosis.candidates.screening import screen
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.checkpoint import CheckpointedRunner
from concent_warp.diagnosis.procedure import Procedure
from concent_warp.diagnosis.tasks import ignore_progress
from concent_warp.effects.registry import effect_class
from concent_warp.fit.effects.cross_validation import cut_blocks
from tests.scenes.swinging import DAMPING, drawing, swung, windows_of


@pytest.fixture(scope="module")
def nodes():
    """A swing damped by viscous friction that dry friction was blamed for first."""
    recording = swung()
    windows = windows_of(recording)
    found = [fit_baseline(drawing(recording), windows, cut_blocks(windows), "mujoco")]
    for name in ("joint_friction", "joint_damping"):
        base = found[-1]
        chosen = fit_candidate(base, screen(base, effect_class(name)("hinge")))
        found.append(add_candidate(base, polish_candidate(base, chosen)))
    return recording, found


def procedure(recording, nodes, folder=None):
    cfg = DiagnoseCfg(jobs=1)
    runner = None if folder is None else CheckpointedRunner(1, ignore_progress, nodes[0].model, folder, "key")
    made = Procedure(nodes[0].model, recording, cfg, runner)
    for last in nodes[1:]:
        # What a search leaves behind after each addition.
        name = last.model.effects[-1].effect.name
        made.record.groups.append((name,))
        made.record.hypotheses.append({name: last.model})
    return made


def test_a_model_without_one_of_its_effects_is_fitted_again(nodes):
    last = nodes[1][-1]
    alone = refit_without_effect(last, 0)
    assert [a.effect.name for a in alone.model.effects] == ["joint_damping"]
    assert alone.model.effects[0].values[0] == pytest.approx(DAMPING, rel=0.05)
    assert alone.ratio == pytest.approx(last.ratio, rel=0.02)


def test_a_model_without_an_effect_that_was_refitted_already_is_found_again(nodes):
    given, _, last = nodes[1]
    alone = refit_without_effect(last, 0)
    refitted = replace(last, fit=replace(last.fit))
    assert without_effect(refitted, 0, [given, alone]) is alone
    assert without_effect(refitted, 1, [given, alone]) is None
    other = replace(alone, windows=tuple(replace(w) for w in alone.windows))
    assert without_effect(refitted, 0, [other]) is None


@pytest.mark.parametrize("kept", [False, True])
def test_an_effect_that_a_later_one_makes_superfluous_is_dropped(nodes, kept, tmp_path):
    recording, found = nodes
    made = procedure(recording, found, tmp_path if kept else None)
    after = made.revision.remove_superfluous(list(found))
    assert [a.effect.name for a in after[-1].model.effects] == ["joint_damping"]
    assert len(after) == len(found) + 1
    assert made.record.groups == [("joint_damping",)]


def test_an_only_effect_stays(nodes):
    recording, found = nodes
    made = procedure(recording, found[:2])
    assert made.revision.remove_superfluous(list(found[:2])) == found[:2]
    assert made.record.groups == [("joint_friction",)]
