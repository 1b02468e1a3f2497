import pytest
import torch
from small_insertion import SETTINGS, make_task

from concent_warp.train.environment.environment import Environment
from concent_warp.train.environment.worlds import make_environment
from concent_warp.train.resets.sample import ResetStates, sample_reset_states
from concent_warp.train.task.task import Task


@pytest.fixture(scope="session")
def task() -> Task:
    return make_task()


@pytest.fixture(scope="session")
def states(task: Task) -> ResetStates:
    return sample_reset_states(task, SETTINGS.reset, 0, count=40)


@pytest.fixture
def environment(task: Task, states: ResetStates) -> Environment:
    torch.manual_seed(0)
    return make_environment(task, SETTINGS, states, device="cpu")
