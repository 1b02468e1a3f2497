import pytest
from gripper_task import Task, insert_from, make_task

from concent_warp.events.sequence import ContactEventSequence


@pytest.fixture(scope="session")
def task() -> Task:
    return make_task()


@pytest.fixture(scope="session")
def turned_task() -> Task:
    return make_task((0.8, 0.2, 0.4, 0.4))


@pytest.fixture(scope="session")
def insertion(task: Task) -> ContactEventSequence:
    """Pick, press beside the hole, slide in, let go, withdraw."""
    return task.events(*insert_from(-0.008, 0.002))
