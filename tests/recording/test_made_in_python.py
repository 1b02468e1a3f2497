"""Recordings that a user makes of arrays: harmless forms are converted, all else is refused in one sentence."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import concent_warp as cw

CART = """<mujoco><worldbody><body><joint name="rail" type="slide" axis="1 0 0" damping="2"/><geom size="0.1" mass="1"/>
</body></worldbody><actuator><motor name="motor" joint="rail"/></actuator>
<sensor><jointpos name="rail_position" joint="rail"/></sensor></mujoco>"""
TIME = np.arange(0, 2, 0.01)
FORCE = np.sin(3 * TIME)
PLACE = 0.1 * np.sin(3 * TIME + 2)


def untyped(given) -> Any:
    """Return what a type checker would refuse."""
    return given


def made(time=TIME, force=FORCE, place=PLACE, actuator="motor", sensor="rail_position", scene=CART, **others):
    action, measured = {actuator: cw.Channel(time, force)}, {sensor: cw.Channel(time, place, 1e-3)}
    return cw.Recording(scene, (cw.Demonstration("swing", action=action, measured=measured, **others),))


@pytest.fixture
def model():
    return cw.Model(cw.Scene(CART))


@pytest.mark.parametrize(
    "given",
    [
        {"place": PLACE[:, None]},
        {"force": FORCE[:, None]},
        {"time": TIME.tolist(), "force": FORCE.tolist(), "place": PLACE.tolist()},
        {"place": [[x] for x in PLACE]},
        {"time": tuple(TIME)},
        {"qpos": [0], "qvel": (0,)},
    ],
)
def test_lists_and_columns_of_one_number_are_taken_as_arrays(model, given):
    d = made(**given)[0]
    assert d.action["motor"].value.shape == d.action["motor"].time.shape == (200,)
    assert d.measured["rail_position"].value.shape == (200, 1)
    np.testing.assert_array_equal(d.measured["rail_position"].value[:, 0], PLACE)
    model.check_recording(made(**given))


def test_whole_numbers_become_floating_point_numbers_and_arrays_are_not_copied():
    channel = cw.Channel(untyped([0, 1]), untyped([3, 4]))
    assert channel.time.dtype == channel.value.dtype == float
    assert cw.Channel(TIME, PLACE).time is TIME


def test_a_recording_of_lists_compares_as_one_of_arrays(model):
    asked = [made(), made(time=untyped(TIME.tolist()), force=FORCE[:, None], place=PLACE[:, None])]
    one, other = (cw.compare(model, recording).summarise("model", "rail_position") for recording in asked)
    assert one.ratio == other.ratio


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"time": 1.764e9 + TIME}, "swing, measured/rail_position, row 0: its clock does not begin with the demonstr"),
        ({"time": np.concatenate([TIME[:50], TIME[48:198]])}, "swing, action/motor, row 50: time does not increase"),
        ({"place": PLACE[:-3]}, r"measured/rail_position: wrong shape of the values; expected \(200, 1\), found \(197"),
        ({"force": FORCE[:-3]}, r"action/motor: wrong shape of the values; expected \(200,\), found \(197,\)"),
        ({"force": np.where(TIME < 0.1, np.nan, FORCE)}, "swing, action/motor, row 0: 10 of 200 values are missing"),
        ({"place": 1000 * PLACE}, "its positions look like millimetres"),
        ({"sensor": "rail"}, r"no such sensor; expected one of \['rail_position'\], found 'rail'"),
        ({"actuator": "force"}, r"no such actuator; expected one of \['motor'\], found 'force'"),
    ],
)
@pytest.mark.parametrize(
    "function", [cw.compare, cw.diagnose, cw.fit_effects, cw.fit_geometry, cw.extract_events, cw.suggest, cw.replay]
)
def test_public_functions_refuse_a_recording_that_contradicts_itself(model, function, given, sentence):
    with pytest.raises(cw.RecordingError, match=sentence):
        function(model, made(**given))


@pytest.mark.parametrize(
    "function",
    [
        *(cw.compare, cw.diagnose, cw.fit_effects, cw.fit_geometry, cw.extract_events, cw.suggest, cw.replay),
        cw.locate_forces,
    ],
)
def test_public_functions_refuse_what_is_no_model_or_no_recording(model, function):
    with pytest.raises(
        cw.ModelError, match=r"^cart.xml: this is not a model; expected a Model, found str; read the fil"
    ):
        function("cart.xml", made())
    with pytest.raises(
        cw.RecordingError, match=r"^train.h5: this is not a recording; expected a Recording, found str; "
    ):
        function(model, "train.h5")
    with pytest.raises(
        cw.RecordingError, match=r"^this is not a recording; expected a Recording, found Demonstration."
    ):
        function(model, made()[0])


def test_one_of_several_models_that_is_none_is_refused():
    with pytest.raises(cw.ModelError, match=r"cart.xml: this is not a model"):
        cw.compare(untyped({"nominal": "cart.xml"}), made())


def test_a_model_of_a_recording_wants_a_recording_with_mjcf_text():
    with pytest.raises(cw.RecordingError, match=r"train.h5: this is not a recording"):
        cw.Model.from_recording(untyped("train.h5"))
    with pytest.raises(
        cw.RecordingError, match=r"the scene is not XML; expected MJCF text, found 'cart.xml'; read a fil"
    ):
        cw.Model.from_recording(made(scene="cart.xml"))


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (
            lambda: cw.Channel(TIME, untyped([[1, 2], [3]])),
            "value of a Channel is not an array; expected numbers, the same co",
        ),
        (lambda: made(scene=untyped(cw.Scene(CART))), "the scene of a recording is not text; expected MJCF text"),
        (
            lambda: cw.Recording(CART, untyped(made()[0])),
            r"not a tuple of Demonstration; found Demonstration; write Recording\(",
        ),
        (lambda: cw.Recording(CART, untyped(("demo_0",))), r"not a tuple of Demonstration; found \['str'\]"),
        (
            lambda: cw.Demonstration("d", action=untyped({"motor": FORCE})),
            "action/motor of demonstration 'd' is not a Channel",
        ),
        (
            lambda: cw.Demonstration("d", measured=untyped([PLACE])),
            "measured of demonstration 'd' is not a dictionary; expecte",
        ),
    ],
)
def test_what_is_no_recording_is_refused_when_it_is_made(make, sentence):
    with pytest.raises(cw.RecordingError, match=sentence):
        make()


def test_a_list_of_demonstrations_becomes_a_tuple():
    assert isinstance(cw.Recording(CART, untyped(list(made().demonstrations))).demonstrations, tuple)


def test_a_model_of_another_robot_says_what_it_has_and_what_was_commanded():
    other = cw.Model(cw.Scene(CART.replace('"motor"', '"winch"')))
    with pytest.raises(
        cw.ModelError, match=r"actuators \['winch'\] as in the model, found \['motor'\] in the recording"
    ):
        other.check_recording(made())
    second = '<body><joint name="hinge"/><geom size="0.1"/></body></worldbody>'
    longer = cw.Model(cw.Scene(CART.replace("</worldbody>", second)))
    with pytest.raises(
        cw.ModelError, match="expected 2 positions in the state as in the model, found 1 in the recordin"
    ):
        longer.check_recording(made(qpos=np.zeros(1)))


def test_readings_of_several_numbers_keep_their_shape():
    d = cw.Demonstration("d", measured={"place": cw.Channel(TIME, np.zeros((200, 3)))})
    assert d.measured["place"].value.shape == (200, 3)
    assert replace(d, task="again").measured is d.measured
