"""The whole chain at a tiny size: teacher, DAgger with images, checkpoint, trials, export, commands."""

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

import concent_warp as cw
from concent_warp.cli import main
from concent_warp.deploy.simulated_images import simulated_images
from concent_warp.errors import ConcentError, RenderError, TrainError
from concent_warp.train.distil.dagger import Dagger
from concent_warp.train.distil.run import Distillation
from concent_warp.train.distil.samples import Samples
from concent_warp.train.learning.metrics import read_curve
from tests.distil.conftest import TINY


def trainer(teacher: cw.Policy, cfg: cw.DistilCfg) -> Dagger:
    """Return a training in worlds of its own."""
    inputs = Distillation(teacher, cfg, lambda environment: simulated_images(environment, cfg.images, cfg.looks))
    environment = inputs.environment("cpu", cfg.seed)
    made = Dagger(environment, teacher.act_in(environment), inputs.make_images(environment), cfg)
    environment.reset()
    return made


def same(a: cw.Student, b: cw.Student) -> bool:
    return all(torch.equal(a.weights["student"][name], value) for name, value in b.weights["student"].items())


def test_the_loss_falls_on_a_fixed_set_of_samples(teacher):
    dagger = replace(TINY.dagger, learning_rate=3e-3, iterations=80, batch=12)
    quiet = cw.AugmentCfg(
        shift=0, brightness=0.0, contrast=0.0, balance=0.0, gamma=(1.0, 1.0), vignette=0.0, noise=0.0, blur=0.0
    )
    made = trainer(teacher, replace(TINY, dagger=dagger, augment=quiet))
    with torch.no_grad():
        for _ in range(6):
            made._collect(beta=1.0)
    assert len(made.samples) == 12
    losses = torch.stack([made._update() for _ in range(120)])[:, 0]
    assert float(losses[-5:].mean()) < 0.5 * float(losses[:5].mean())


def test_labels_are_the_actions_of_the_teacher_on_the_true_state(teacher):
    made = trainer(teacher, TINY)
    environment = made.environment
    expected = teacher.act_in(environment)({"policy": environment.truth.clone()})  # pyright: ignore[reportArgumentType]
    with torch.no_grad():
        made._collect(beta=0.0)
    assert torch.allclose(made.samples.action[:2], expected, atol=1e-5)


def test_stages_follow_one_another_earlier_than_in_the_teachers_training_and_never_later():
    teacher = cw.load_policy("pick_align_insert")
    for tolerance, expected in ((0.01, 0.01), (0.001, 0.004)):
        cfg = replace(TINY, states=8, free=1.0, tolerance=tolerance)
        environment = Distillation(teacher, cfg, lambda _: None).environment("cpu", 0)  # pyright: ignore
        assert environment._settings.chain.tolerance == expected
        assert bool(environment._from_start.all())


def test_the_physics_of_the_stress_test_can_be_learnt_in(teacher):
    usual, stress = (trainer(teacher, replace(TINY, physics=physics)) for physics in ("training", "stress"))
    steps = [made.environment.physics.model.opt.timestep for made in (usual, stress)]  # pyright: ignore
    assert steps[1] == pytest.approx(steps[0] / teacher.run.cfg.stress.refine)
    boxes = [one.environment.task.compiled.geom_type == mujoco.mjtGeom.mjGEOM_BOX for one in (usual, stress)]
    solid = [
        (made.environment.task.compiled.geom_contype > 0) & box
        for made, box in zip((usual, stress), boxes, strict=True)
    ]
    assert solid[1].sum() > solid[0].sum()
    with torch.no_grad():
        stress._collect(beta=0.0)
    assert bool(stress.samples.action[:2].isfinite().all())


def test_a_distillation_that_stopped_continues_exactly(teacher, student, tmp_path):
    out = tmp_path / "stopped"
    stopped = cw.distil(teacher, TINY, device="cpu", out=out, seconds=0)
    assert stopped.weights["iteration"] == 1
    assert list(out.glob("samples_0_*.bin"))
    torch.manual_seed(99)
    whole = cw.distil(teacher, TINY, device="cpu", out=out, resume=True)
    assert whole.weights["iteration"] == 3
    assert same(whole, student)
    assert not list(out.glob("samples_*"))
    assert [point["iteration"] for point in read_curve(out)] == [1, 2, 3]


def test_checkpoints_that_take_long_are_written_less_often(teacher, tmp_path, monkeypatch):
    written, save = [], Samples.save

    def slow(samples: Samples, path: Path) -> None:
        save(samples, path)
        time.sleep(0.5)
        written.append(path.name)

    monkeypatch.setattr(Samples, "save", slow)
    # The first checkpoint, without samples, is slow on a busy disk: after so many iterations one with samples is due.
    often = replace(TINY, checkpoint=1e-3, dagger=replace(TINY.dagger, iterations=20, updates=1))
    cw.distil(teacher, often, device="cpu", out=tmp_path / "student")
    assert len(written) == 1


def test_a_distillation_begins_with_another_student_and_keeps_its_statistics(teacher, student):
    larger = replace(TINY, images=replace(TINY.images, size=2 * TINY.images.size))
    still = replace(larger, dagger=replace(TINY.dagger, iterations=1, learning_rate=1e-12, decay=0.0))
    begun = cw.distil(teacher, still, begin_with=student, device="cpu")
    assert begun.weights["iteration"] == 1
    for name, value in student.weights["student"].items():
        assert torch.allclose(begun.weights["student"][name], value, atol=1e-5), name


def test_missing_networks_are_refused_before_worlds_are_made(teacher, monkeypatch):
    monkeypatch.setattr("concent_warp.deploy.distil.run_distillation", lambda *_, **__: pytest.fail("worlds were made"))
    with pytest.raises(RenderError, match="no trained networks"):
        cw.distil(teacher, replace(TINY, images=replace(TINY.images, networks="gone")), device="cpu")


def test_a_student_of_another_network_is_none_to_begin_with(teacher, student, tmp_path):
    wider = replace(TINY, network=replace(TINY.network, keypoints=2 * TINY.network.keypoints))
    with pytest.raises(TrainError, match="the student to begin with"):
        cw.distil(teacher, wider, begin_with=student, device="cpu", out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_distillation_of_rsl_rl_is_a_baseline_that_resumes(teacher, tmp_path):
    cfg = replace(TINY, method="rsl_rl", dagger=replace(TINY.dagger, iterations=2))
    whole = cw.distil(teacher, cfg, device="cpu")
    stopped = cw.distil(teacher, cfg, device="cpu", out=tmp_path / "run", seconds=0)
    assert stopped.weights["iteration"] == 1
    assert not same(stopped, whole)
    assert same(cw.distil(teacher, cfg, device="cpu", out=tmp_path / "run", resume=True), whole)


def test_the_run_folder_holds_metrics_and_the_teacher(folder, teacher):
    points = read_curve(folder)
    assert [point["beta"] for point in points] == [1.0, 0.5, 0.0]
    assert all(np.isfinite(point["loss action"]) for point in points)
    again = cw.load_policy(folder / "teacher")
    assert again.run.cfg == teacher.run.cfg


def test_another_teacher_or_other_settings_do_not_continue_a_distillation(folder, teacher):
    with pytest.raises(TrainError, match="other settings"):
        cw.distil(teacher, replace(TINY, seed=5), device="cpu", out=folder, resume=True)
    other = {**teacher.weights["actor_state_dict"]}
    name = next(iter(other))
    changed = replace(teacher, weights={**teacher.weights, "actor_state_dict": {**other, name: other[name] + 1}})
    with pytest.raises(TrainError, match="another teacher"):
        cw.distil(changed, TINY, device="cpu", out=folder, resume=True)
    with pytest.raises(ConcentError, match="holds a run"):
        cw.distil(teacher, TINY, device="cpu", out=folder)


def test_images_of_the_worlds_reach_the_action(student):
    run = student.run
    task = run.task()
    states = run.evaluation_states(task, 2, 0)
    from concent_warp.train.environment.worlds import make_environment

    environment = make_environment(task, replace(run.cfg.environment, worlds=2), states, device="cpu")
    environment.start_from([0, 1])
    source = simulated_images(environment, student.cfg.images, student.cfg.looks)
    observation = environment.get_observations()
    actions: list[torch.Tensor] = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)  # of the looks
        actions.append(student.act_in(environment, source)(observation))
    assert torch.equal(actions[0], actions[1])
    assert not torch.equal(actions[0], actions[2])


@pytest.mark.parametrize("world", ["simulation", "reality"])
def test_a_student_is_tried_by_its_images(student, world):
    found = cw.evaluate(student, world=world, episodes=2, device="cpu")
    assert found.success.shape == (2,)
    assert (found.length > 0).all()


def test_the_controller_acts_as_the_exported_student(student, tmp_path):
    from onnx.reference import ReferenceEvaluator

    described = student.export(tmp_path / "student.onnx")
    controller = student.controller()
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (3, *controller.images), dtype=np.uint8)
    own = rng.normal(size=(3, controller.proprioception.size)).astype(np.float32)
    expected = controller.act(images, own)
    found: Any = ReferenceEvaluator(str(tmp_path / "student.onnx")).run(None, {"images": images, "proprioception": own})
    assert np.allclose(found[0], expected, atol=1e-5)
    assert described["images"]["shape"] == list(controller.images)
    assert sum(part["size"] for part in described["observation"]["parts"]) == controller.proprioception.size
    assert not any(part["name"].startswith("object") for part in described["observation"]["parts"])


def test_the_controller_refuses_what_the_student_does_not_see(student):
    controller = student.controller()
    own = np.zeros((1, controller.proprioception.size), np.float32)
    with pytest.raises(TrainError, match="images are not as the student sees"):
        controller.act(np.zeros((1, *controller.images), np.float32), own)
    with pytest.raises(TrainError, match="proprioception is not"):
        controller.act(np.zeros((1, *controller.images), np.uint8), own[:, 1:])


def test_the_commands_train_and_try_a_blind_student(tmp_path, capsys):
    out = tmp_path / "blind"
    words = (
        f"distil shape_sorter -o {out} --device cpu --worlds 2 --iterations 1 --size 16 --blind --states 4 "
        "--dagger.steps 2 --dagger.updates 1 --dagger.batch 2 --network.channels 8 8 --network.hidden 16"
    )
    assert main(words.split()) == 0
    assert "wrote" in capsys.readouterr().out
    assert cw.load_student(out).cfg.network.blind
    assert main(f"evaluate --checkpoint {out} --world simulation --episodes 1 --device cpu --json".split()) == 0
    assert json.loads(capsys.readouterr().out)["worlds"]["simulation"]["episodes"] == 1
    assert main(f"export --checkpoint {out} -o {tmp_path / 'blind.pt'}".split()) == 0
    assert "cameras" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("distil nobody -o OUT", "no such"),
        ("distil shape_sorter -o OUT --images.cameras ceiling --device cpu --states 4 --worlds 2", "no such camera"),
        ("distil shape_sorter -o OUT --images.networks gone --device cpu --states 4 --worlds 2", "no trained networks"),
        ("distil STUDENT -o OUT", "this is a student"),
        ("play --checkpoint STUDENT", "this is a student"),
        ("export --checkpoint STUDENT --as-pretrained -o OUT", "this is a student"),
        ("distil shape_sorter -o OUT --dagger.batch 0", "batch"),
        ("distil shape_sorter -o OUT --device tpu", "device"),
    ],
)
def test_wrong_inputs_give_a_sentence(words, said, folder, tmp_path, capsys):
    out = tmp_path / "out"
    given = words.replace("OUT", str(out)).replace("STUDENT", str(folder)).split()
    assert main(given) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
    assert not out.exists()


def test_a_damaged_student_is_refused(folder, tmp_path):
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    content = (copy / "checkpoint.pt").read_bytes()
    (copy / "checkpoint.pt").write_bytes(content[: len(content) // 2])
    with pytest.raises(TrainError, match="not a checkpoint"):
        cw.load_student(copy)
    (copy / "distil.toml").unlink()
    with pytest.raises(TrainError, match="holds no student"):
        cw.load_student(copy)
