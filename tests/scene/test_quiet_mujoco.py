"""MuJoCo's warnings are off while anyone wants them off, and on again afterwards."""

from contextlib import ExitStack

import mujoco

from concent_warp.scene.quiet_mujoco import quiet_mujoco


def test_warnings_are_back_whichever_of_two_threads_leaves_first():
    before = mujoco.get_mju_user_warning()
    assert before is not None
    first, second = ExitStack(), ExitStack()
    first.enter_context(quiet_mujoco())
    second.enter_context(quiet_mujoco())
    first.close()
    assert mujoco.get_mju_user_warning() is not before
    second.close()
    assert mujoco.get_mju_user_warning() is before


def test_warnings_are_off_within_and_back_after_an_error():
    before = mujoco.get_mju_user_warning()
    try:
        with quiet_mujoco(), quiet_mujoco():
            assert mujoco.get_mju_user_warning() is not before
            raise RuntimeError
    except RuntimeError:
        pass
    assert mujoco.get_mju_user_warning() is before
