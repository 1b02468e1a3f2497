"""Payloads: known weights that bodies carry in some demonstrations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import concent_warp as cw
from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.checkpoint import _fingerprint
from concent_warp.errors import RecordingError
from concent_warp.fit.effects.observe import observe
from concent_warp.fit.effects.prediction import Prediction, SimulationRequest
from concent_warp.recording.formats.csv import read_csv
from concent_warp.recording.recording import Recording
from concent_warp.scene.payloads import Payload, scene_with_payloads
from concent_warp.train.run import TrainingRun

BOB = Payload("arm", 0.2, (0.0, 0.01, -0.1), (1e-4, 1e-4, 5e-5))


@pytest.fixture(scope="module")
def servo() -> Recording:
    """Return the recording of a servo that swings an arm."""
    return cw.load_recording(cw.example("servo"))


def carrying(recording: Recording, *payloads: Payload) -> Recording:
    """Return a recording in whose demonstrations bodies carried payloads."""
    return replace(recording, demonstrations=tuple(replace(d, payloads=payloads) for d in recording.demonstrations))


def test_a_payload_is_a_rigid_part_of_what_carries_it(servo):
    model = cw.Model.from_recording(servo)
    plain, heavy = model.compile(), model.with_payloads((BOB,)).compile()
    own = heavy.body("arm_payload0")
    assert heavy.body_mass.sum() == pytest.approx(plain.body_mass.sum() + 0.2)
    np.testing.assert_allclose(own.pos, BOB.position)
    np.testing.assert_allclose(own.inertia, BOB.inertia)
    assert heavy.body_weldid[own.id] == heavy.body("arm").id
    assert (heavy.nq, heavy.nu, heavy.ngeom, heavy.nsensor) == (plain.nq, plain.nu, plain.ngeom, plain.nsensor)
    # About the hinge, by Steiner's theorem.
    hinge = heavy.dof_M0[0] - plain.dof_M0[0]
    assert hinge == pytest.approx(0.2 * 0.1**2 + (1e-4 if plain.jnt_axis[0][1] else 1e-4 + 0.2 * 0.01**2), rel=0.02)


def test_weights_without_inertia_and_several_on_a_body(servo):
    scene = cw.Model.from_recording(servo).scene
    m = scene_with_payloads(scene, (Payload("arm", 0.1), Payload("arm", 0.3, (0.0, 0.0, -0.2)))).model
    assert [float(m.body(f"arm_payload{k}").mass[0]) for k in (0, 1)] == [0.1, 0.3]


def test_replays_and_windows_of_a_demonstration_have_its_payloads(servo):
    model, loaded = cw.Model.from_recording(servo), carrying(servo, BOB)
    plain, heavy = (cw.replay(model, r)["demo_0"] for r in (servo, loaded))
    truth = cw.replay(model.with_payloads((BOB,)), servo)["demo_0"]
    assert np.abs(plain.qpos - heavy.qpos).max() > 1e-3
    np.testing.assert_allclose(heavy.qpos, truth.qpos)
    assert heavy.bodies == plain.bodies
    windows = observe(model, loaded)
    found, expected = (
        p.residuals([SimulationRequest(0, p.start)])[0]
        for p in (
            Prediction(model, (), windows),
            Prediction(
                model.with_payloads((BOB,)),
                (),
                [replace(w, demonstration=replace(w.demonstration, payloads=())) for w in windows],
            ),
        )
    )
    np.testing.assert_allclose(found, expected)


def test_a_payload_gets_a_name_that_is_free(servo):
    scene = cw.Model.from_recording(servo).scene
    twice = scene_with_payloads(scene_with_payloads(scene, (BOB,)), (BOB,)).model
    assert [twice.body(b).name for b in range(twice.nbody)][-2:] == ["arm_payload0", "arm_payload0_"]


def test_an_interrupted_diagnosis_is_not_continued_with_other_payloads(servo):
    model = cw.Model.from_recording(servo)
    of = [_fingerprint(model, r, DiagnoseCfg(), {}) for r in (servo, carrying(servo, BOB), carrying(servo))]
    assert of[0] == of[2] != of[1]


def test_payloads_are_kept_in_a_file(servo, tmp_path):
    second = Payload("arm", 0.05)
    cw.write_hdf5(carrying(servo, BOB, second), tmp_path / "loaded.h5")
    assert cw.load_recording(tmp_path / "loaded.h5")[0].payloads == (BOB, second)


def test_payloads_of_a_folder_of_csv_files(servo, tmp_path):
    (tmp_path / "scene.xml").write_text(servo.scene)
    d = servo[0]
    for kind, channels in (("action", d.action), ("measured", d.measured)):
        for name, c in channels.items():
            table = np.column_stack([c.time, np.asarray(c.value).reshape(len(c.time), -1)])
            names = ",".join(["time", *(f"v{k}" for k in range(table.shape[1] - 1))])
            if kind == "measured" and table.shape[1] != 2:
                names = "time,x,y,z"
            np.savetxt(tmp_path / f"{kind}_{name}.csv", table, delimiter=",", header=names, comments="")
    (tmp_path / "payloads.csv").write_text("body,mass,x,y,z\narm,0.2,0,0.01,-0.1\n")
    assert read_csv(tmp_path)[0].payloads == (replace(BOB, inertia=(0.0, 0.0, 0.0)),)
    (tmp_path / "payloads.csv").write_text("arm,0.2,0,0.01,-0.1\n")
    with pytest.raises(RecordingError, match=r"payloads\.csv, line 1.*body,mass,x,y,z"):
        read_csv(tmp_path)
    (tmp_path / "payloads.csv").write_text("body,mass,x,y,z\narm,0.2,0,0.01\n")
    with pytest.raises(RecordingError, match=r"line 2.*number of cells"):
        read_csv(tmp_path)


def test_a_training_refuses_payloads(servo):
    model = cw.Model.from_recording(servo)
    with pytest.raises(RecordingError, match="a training"):
        TrainingRun.new(model, carrying(servo, BOB), cw.TrainCfg())


@pytest.mark.parametrize(
    ("payload", "said"),
    [
        (Payload("leg", 0.1), "nothing that moves"),
        (Payload("world", 0.1), "nothing that moves"),
        (Payload("arm", 0.0), "mass"),
        (Payload("arm", float("nan")), "mass"),
        (Payload("arm", 0.1, (0.0, float("inf"), 0.0)), "position"),
        (Payload("arm", 0.1, inertia=(1e-4, 1e-4, 3e-4)), "moments of inertia"),
        (Payload("arm", 0.1, inertia=(-1e-4, 1e-4, 1e-4)), "moments of inertia"),
    ],
)
def test_payloads_that_cannot_be_are_refused(servo, tmp_path, payload, said):
    with pytest.raises(RecordingError, match=said):
        cw.write_hdf5(carrying(servo, payload), tmp_path / "wrong.h5")
    assert not list(tmp_path.iterdir())


def test_a_fit_of_contact_geometry_refuses_payloads():
    run = cw.load_policy("shape_sorter").run
    loaded = carrying(run.recording, Payload("block", 0.1))
    with pytest.raises(RecordingError, match="payload, which a fit of contact geometry does not take into account"):
        cw.fit_geometry(run.model, loaded, cw.FitCfg(generations=1), engine="mujoco")
