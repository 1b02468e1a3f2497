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


def test_an_effect_that_is_only_possible_has_an_interval_that_nothing_was_fitted_to(script):
    from concent_warp.model import Model
    from concent_warp.scene.shape_sorter import ShapeSorterCfg

    cases = script("benchmarks.train.cases")
    model = cases.with_spread(Model(ShapeSorterCfg().build()), "actuator_delay=0.2", (0.0, 0.3))
    (added,) = model.effects
    assert added.effect.name == "actuator_delay"
    assert added.values == (0.15,)
    assert added.intervals == ((0.0, 0.3),)


def test_a_demonstration_that_fails_is_recorded_again(script, monkeypatch):
    from types import SimpleNamespace

    from concent_warp.scene.shape_sorter import ShapeSorterCfg

    cases, asked = script("benchmarks.train.cases"), []

    def record(_cfg, seeds, **_given):
        asked.extend(seeds)
        return seeds, [SimpleNamespace(success=seeds[0] == fine)]

    monkeypatch.setattr(cases, "record", record)
    fine = 7002
    assert cases.demonstrate(7, (), ShapeSorterCfg())[0] == [fine]
    assert asked == [7000, 7001, 7002]
    fine = None
    with pytest.raises(SystemExit, match="none of 10 demonstrations succeeds with nothing hidden"):
        cases.demonstrate(7, (), ShapeSorterCfg())
