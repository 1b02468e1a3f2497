"""The benchmark of hidden effects from video."""

import pytest


def test_unknown_names_of_data_sets_are_refused(script, tmp_path):
    module = script("benchmarks.perception.hidden_effects")
    args = module.Args(names=("drop-wind-middle", "drop-magic-middle"), data=tmp_path / "x.jsonl")
    with pytest.raises(SystemExit, match="no data set drop-magic-middle"):
        module.main(args)
    assert not list(tmp_path.iterdir())
