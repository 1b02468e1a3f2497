"""Seeds, devices and numbers that make no sense are refused in one sentence, before any work."""

from functools import partial
from importlib import import_module
from pathlib import Path

import pytest
import torch

import concent_warp as cw
from concent_warp.checks import Bounds, check_at_least, check_device, check_seed, check_settings
from concent_warp.cli import main
from concent_warp.cli.entry import COMMANDS
from concent_warp.errors import ConcentError
from concent_warp.reality.record import RealityCfg, record
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.warp_engine import WarpEngine


@pytest.mark.parametrize("seed", [-1, 2**32, 1 << 20_000], ids=["negative", "large", "huge"])
def test_seeds_out_of_bounds_are_refused(seed):
    with pytest.raises(
        ConcentError, match=r"the seed is out of bounds; expected 0 to 4294967295, found [-\w ]{1,20}\.$"
    ):
        check_seed(seed)


def test_seeds_of_functions_are_checked():
    policy = cw.load_policy("shape_sorter")
    with pytest.raises(ConcentError, match="the seed"):
        record(RealityCfg(), [0, -1])
    with pytest.raises(ConcentError, match="seed is out of bounds"):
        cw.TrainCfg(seed=-1)
    with pytest.raises(ConcentError, match="the seed"):
        cw.evaluate(policy, episodes=1, seed=-1)
    with pytest.raises(ConcentError, match="the seed"):
        cw.play(policy, seed=-1)
    with pytest.raises(ConcentError, match="seed is out of bounds"):
        cw.render(policy, "nowhere", cw.RenderCfg(seed=-1))
    assert not Path("nowhere").exists()


@pytest.mark.parametrize(
    ("name", "count", "said"),
    [
        ("cuda:0", 0, 'there is no device cuda:0; expected "cpu", found no CUDA device.'),
        ("cuda", 0, 'there is no device cuda; expected "cpu", found no CUDA device.'),
        ("cuda:7", 1, 'there is no device cuda:7; expected "cpu" or "cuda:0", found 1 CUDA device.'),
        ("cuda:7", 2, 'there is no device cuda:7; expected "cpu" or "cuda:0" or "cuda:1", found 2 CUDA devices.'),
        ("gpu", 1, 'no such device; expected "cpu" or "cuda:0", found \'gpu\'.'),
        ("cuda:-1", 1, 'no such device; expected "cpu" or "cuda:0", found \'cuda:-1\'.'),
    ],
)
def test_devices_that_are_not_there_are_refused(monkeypatch, name, count, said):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    with pytest.raises(ConcentError) as raised:
        check_device(name)
    assert str(raised.value) == said
    for there in (None, "cpu", *(f"cuda:{k}" for k in range(count))):
        check_device(there)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("train demo.h5 --model model.toml --device cuda:7", "there is no device cuda:7"),
        ("evaluate --pretrained --device cuda:0", "there is no device cuda:0"),
        ("play --pretrained --device tpu", "no such device"),
        ("render --pretrained --device cuda:0", "there is no device cuda:0"),
        ("splat-fit images --device cuda:0", "there is no device cuda:0"),
        ("render-train demo.h5 --device cuda:0", "there is no device cuda:0"),
        ("demo --seeds -1", "--seeds is out of bounds; expected 0 to 4294967295"),
        ("demo --unseen-seeds 0 -5", "--unseen-seeds is out of bounds; expected 0 to 4294967295"),
        ("record --seeds -1", "--seeds is out of bounds; expected 0 to 4294967295"),
        ("evaluate --pretrained --seed -1", "--seed is out of bounds; expected 0 to 4294967295"),
        ("fit demo.h5 --fit.seed -1", "--fit.seed is out of bounds; expected 0 to 4294967295"),
        ("diagnose demo.h5 --seed -1", "--seed is out of bounds; expected 0 to 4294967295"),
        ("splat-fit images --fit.seed -1", "--fit.seed is out of bounds; expected 0 to 4294967295"),
        ("record --reality.place-spread nan", "--reality.place-spread is not a number"),
    ],
)
def test_commands_refuse_them_at_once(monkeypatch, tmp_path, capsys, command, said):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    assert main(command.split()) == 2
    assert said in capsys.readouterr().err.strip().splitlines()[-1]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", COMMANDS)
def test_default_settings_pass(command):
    module = import_module(f"concent_warp.cli.commands.{command.replace('-', '_')}")
    for field in module.Arguments.__dataclass_fields__.values():
        if callable(getattr(field, "default_factory", None)):
            check_settings(field.default_factory())


def test_numbers_below_a_bound_are_refused():
    check_at_least(1, size=1, count=None)
    for value in (0, float("nan"), float("inf")):
        with pytest.raises(ConcentError, match="size is out of bounds; expected at least 1, found"):
            check_at_least(1, size=value)


@pytest.mark.parametrize("option", ["nconmax", "njmax", "max_memory", "max_worlds"])
def test_engines_refuse_buffers_without_room(option):
    model = cw.load_policy("shape_sorter").run.model
    with pytest.raises(cw.EngineError, match=f"{option} is out of bounds; expected at least 1, found 0"):
        partial(WarpEngine, model, **{option: 0})()


@pytest.mark.parametrize("option", ["threads", "memory", "max_memory"])
def test_mujoco_refuses_no_threads_and_no_memory(option):
    model = cw.load_policy("shape_sorter").run.model
    with pytest.raises(cw.EngineError, match=f"{option} is out of bounds"):
        partial(MujocoEngine, model, **{option: 0})()


@pytest.mark.parametrize(
    ("function", "cfg", "said"),
    [
        ("fit_geometry", cw.FitCfg(held_out=1.0), "held_out is out of bounds; expected at least 0 and below 1"),
        ("fit_geometry", cw.FitCfg(generations=-1), "generations is out of bounds"),
        ("fit_effects", cw.FitEffectsCfg(window=0.0), "window is out of bounds; expected at least 0.001"),
        ("compare", cw.CompareCfg(seed=-1), "seed is out of bounds; expected 0 to 4294967295"),
        ("diagnose", cw.DiagnoseCfg(jobs=0), "jobs is out of bounds; expected at least -1 and at most 4096, but not 0"),
        ("diagnose", cw.DiagnoseCfg(significance_level=float("nan")), "significance_level is not a number"),
        ("locate_forces", cw.LocateForcesCfg(length=-0.1), "length is out of bounds"),
        ("suggest_experiment", cw.SuggestExperimentCfg(finalists=0), "finalists is out of bounds; expected at least 1"),
        ("ground", cw.GroundCfg(fit=cw.FitCfg(block=0.0)), "fit.block is out of bounds; expected at least 0.001"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_functions_of_the_library_refuse_settings_out_of_bounds(function, cfg, said, tmp_path):
    recording = cw.load_recording(cw.example("servo"))
    model = cw.Model.from_recording(recording)
    first = {
        "compare": ({"model": model}, recording),
        "suggest_experiment": ({"model": model}, recording),
        "ground": (recording, tmp_path / "run"),
    }
    with pytest.raises(ConcentError, match=f"^{said}"):
        getattr(cw, function)(*first.get(function, (model, recording)), cfg)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("function", ["evaluate", "play", "render"])
def test_functions_of_policies_refuse_settings_out_of_bounds(function, tmp_path):
    policy = cw.load_policy("shape_sorter")
    cfg = {"evaluate": cw.EvaluateCfg(action_scale=1.5), "play": cw.PlayCfg(port=-1), "render": cw.RenderCfg(size=0)}
    out = (tmp_path / "run",) if function == "render" else ()
    with pytest.raises(ConcentError, match=r"^(action_scale|port|size) is out of bounds; expected"):
        getattr(cw, function)(policy, *out, cfg[function])
    assert not (tmp_path / "run").exists()


def test_bounds_are_said_in_words():
    assert Bounds(0, 1, above_low=True).sentence() == "above 0 and at most 1"
    assert Bounds(-1, 4, below_high=True, excluded=0).sentence() == "at least -1 and below 4, but not 0"
    inside = [Bounds(0, 1, above_low=True).include(value) for value in (0, 0.5, 1, 2)]
    assert inside == [False, True, True, False]
    assert [Bounds(0, 1, below_high=True).include(value) for value in (-1, 0, 1)] == [False, True, False]
    assert not Bounds(-1, 4, excluded=0).include(0)
