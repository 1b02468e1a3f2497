import pytest

from concent_warp.errors import EngineError
from concent_warp.simulate import select
from concent_warp.simulate.mujoco_engine import MujocoEngine
from concent_warp.simulate.select import make_engine


def test_auto_is_mujoco_where_there_is_no_cuda_device(model, monkeypatch):
    monkeypatch.setattr(select, "has_cuda", lambda: False)
    engine = make_engine("auto", model, threads=1)
    assert isinstance(engine, MujocoEngine)
    assert engine.threads == 1


def test_auto_is_warp_where_there_is_a_cuda_device(model, monkeypatch):
    from concent_warp.simulate.warp_engine import WarpEngine

    monkeypatch.setattr(select, "has_cuda", lambda: True)
    engine = make_engine("auto", model, collidable=model.geometry.body == 0, device="cpu")
    assert isinstance(engine, WarpEngine)
    assert (engine.sphere_geom < 0).sum() == 12


def test_unknown_engine_is_named(model):
    with pytest.raises(EngineError, match="'bullet'"):
        make_engine("bullet", model)  # pyright: ignore[reportArgumentType]
