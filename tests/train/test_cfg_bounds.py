"""Settings of a training that make no sense are refused, each by its name."""

import dataclasses

import pytest
from small_insertion import SETTINGS, make_task

from concent_warp.errors import TrainError
from concent_warp.train import check_cfg
from concent_warp.train.cfg import TrainCfg
from concent_warp.train.environment.worlds import check_worlds, make_environment

NUMBERS = sorted({name for name, _ in check_cfg._numbers(TrainCfg(target=0.5))} | {"environment.nconmax"})


def changed(cfg, name: str, value: object):
    """Return settings in which the one of a dotted name has another value."""
    first, _, rest = name.partition(".")
    if rest:
        return dataclasses.replace(cfg, **{first: changed(getattr(cfg, first), rest, value)})
    before = getattr(cfg, first)
    return dataclasses.replace(cfg, **{first: (value,) * len(before) if isinstance(before, tuple) else value})


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1])
def test_no_setting_is_negative_or_not_finite(name, value):
    if value == -1 and name in check_cfg.SIGNED and name != "seed":
        assert changed(TrainCfg(), name, value)
        return
    with pytest.raises(TrainError, match=r"(is|are) out of bounds|is not a"):
        changed(TrainCfg(), name, value)


@pytest.mark.parametrize("name", [*check_cfg.COUNTS, *check_cfg.POSITIVE])
def test_counts_and_sizes_are_above_zero(name):
    last = name.split(".")[-1]
    with pytest.raises(TrainError, match=f"^{last} is out of bounds; expected (at least 1|above 0), found 0"):
        changed(TrainCfg(), name, 0)


@pytest.mark.parametrize("name", check_cfg.SHARES)
def test_shares_are_at_most_one(name):
    with pytest.raises(TrainError, match=r"expected 0 to 1, found 1\.5"):
        changed(TrainCfg(), name, 1.5)
    changed(TrainCfg(), name, 1.0)


@pytest.mark.parametrize("name", check_cfg.INTERVALS)
def test_intervals_are_in_order(name):
    path = f"environment.randomisation.{name}"
    randomisation = dataclasses.replace(TrainCfg().environment.randomisation, **{name: (2.0, 1.0)})
    with pytest.raises(TrainError, match=f"{name} is out of bounds; expected a smallest and a largest value"):
        changed(TrainCfg(), "environment.randomisation", randomisation)
    if name in check_cfg.FACTORS:
        with pytest.raises(TrainError, match="above 0"):
            changed(TrainCfg(), path, 0.0)


def test_networks_have_layers():
    with pytest.raises(TrainError, match="hidden is empty"):
        dataclasses.replace(TrainCfg(), ppo=dataclasses.replace(TrainCfg().ppo, hidden=()))


def test_worlds_that_do_not_fit_the_memory_are_refused(states):
    task, many = make_task(), dataclasses.replace(SETTINGS, worlds=10**9)
    with pytest.raises(
        TrainError, match=r"cpu: so many worlds do not fit the memory; expected at most [\d,]+ of \d+ kB"
    ):
        check_worlds(task, many, "cpu")
    with pytest.raises(TrainError, match="found 1,000,000,000; lower --worlds"):
        make_environment(task, many, states, device="cpu")
    check_worlds(task, SETTINGS, "cpu")
