"""Settings of a training that make no sense are refused, each by its name."""

import dataclasses

import pytest
from small_insertion import SETTINGS, make_task

from concent_warp.checks import _settings
from concent_warp.errors import TrainError
from concent_warp.train.cfg import TrainCfg
from concent_warp.train.environment.worlds import check_worlds, make_environment

NUMBERS = sorted(
    {name for name, value, _ in _settings(TrainCfg(target=0.5)) if type(value) in (int, float)}
    | {"environment.nconmax", "environment.stride"}
)
COUNTS = (
    "checkpoint", "environment.worlds", "environment.decimation", "environment.stride", "environment.nconmax",
    "environment.njmax", "environment.solver_iterations", "environment.ls_iterations", "environment.observation.slots",
    "environment.observation.history", "environment.reset.stuck.states", "stress.episodes", "stress.refine",
    "environment.virtual.candidates", "environment.virtual.threads",
    "environment.reset.states", "environment.reset.passes", "environment.reset.posture_solver.iterations",
    "environment.reset.newton_solver.iterations", "environment.reset.newton_solver.seeds", "environment.chain.hold",
    "ppo.iterations", "ppo.steps", "ppo.epochs", "ppo.batches", "ppo.hidden",
)  # fmt: skip
"""Settings of at least 1."""
POSITIVE = (
    "environment.episode", "environment.success", "environment.dropped", "environment.lost", "environment.max_position",
    "environment.max_velocity", "environment.buffer_factor", "environment.action.turn", "environment.action.slide",
    "environment.action.gripper", "environment.action.turn_lead", "environment.action.slide_lead",
    "environment.chain.tolerance", "environment.reset.stuck.within",
    "environment.edges.radius", "environment.edges.reach",
    "ppo.learning_rate", "ppo.std", "ppo.max_mean", "ppo.max_observation", "ppo.clip",
    "ppo.divergence", "ppo.gradient",
)  # fmt: skip
"""Settings above 0."""
SHARES = (
    "target", "environment.randomisation.perturbation_share", "environment.reset.demonstrated",
    "environment.reset.free", "environment.reset.stuck.share", "environment.observation.sensors.constant_share",
    "environment.observation.sensors.dropout", "ppo.discount", "ppo.lam",
)  # fmt: skip
"""Settings from 0 to 1."""
SIGNED = (
    "environment.reset.before", "environment.reward.engineered.hole", "environment.reward.engineered.seat",
    *(f"{of}.sensors.{what}_bias"
      for of in ("environment.observation", "stress") for what in ("position", "orientation")),
)  # fmt: skip
"""Settings that may be negative; all others may not."""
INTERVALS = ("friction", "grip", "stiffness", "damping", "mass", "joint_friction", "delay", "lag")
"""Settings of the randomisation that are a smallest and a largest value."""
FACTORS = ("friction", "grip", "stiffness", "damping", "mass")
"""Those that are factors, above 0."""


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
    if value == -1 and name in SIGNED:
        assert changed(TrainCfg(), name, value)
        return
    with pytest.raises(TrainError, match=r"(is|are) out of bounds|is not a"):
        changed(TrainCfg(), name, value)


@pytest.mark.parametrize("name", [*COUNTS, *POSITIVE])
def test_counts_and_sizes_are_above_zero(name):
    said = f"^{name} is out of bounds; expected (at least 1|above 0) and at most .*, found 0"
    with pytest.raises(TrainError, match=said):
        changed(TrainCfg(), name, 0)


@pytest.mark.parametrize("name", SHARES)
def test_shares_are_at_most_one(name):
    with pytest.raises(TrainError, match=r"expected at least 0 and at most 1, found 1\.5"):
        changed(TrainCfg(), name, 1.5)
    changed(TrainCfg(), name, 1.0)


@pytest.mark.parametrize("name", INTERVALS)
def test_intervals_are_in_order(name):
    path = f"environment.randomisation.{name}"
    randomisation = dataclasses.replace(TrainCfg().environment.randomisation, **{name: (2.0, 1.0)})
    with pytest.raises(TrainError, match=f"{name} is out of bounds; expected a smallest and a largest value"):
        changed(TrainCfg(), "environment.randomisation", randomisation)
    if name in FACTORS:
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
