"""Effects on single elements of a selection, which a diagnosis tries after those on all of them."""

from concent_warp.diagnosis.candidates.candidates import is_single_of_many, label
from concent_warp.effects.registry import effect_class
from concent_warp.model import Model
from concent_warp.scene.scene import Scene
from tests.scenes.foreign import BALL, PUSHER

SPEEDS = PUSHER.replace("</sensor>", '<jointvel name="elbow_speed" joint="elbow"/></sensor>')


def test_what_one_of_several_instruments_reads_may_be_late():
    m = Model(Scene(SPEEDS)).compile()
    latency = effect_class("latency")
    assert latency.single_targets(m) == (("shoulder_position",), ("elbow_position", "elbow_speed"))
    assert latency.single_targets(Model(Scene(BALL)).compile()) == ()
    every = latency("shoulder_position", "elbow_position", "elbow_speed")
    one = latency("elbow_position", "elbow_speed")
    assert is_single_of_many(one, [every, one])
    assert not is_single_of_many(every, [every, one])


def test_one_of_several_drives_may_be_late():
    m = Model(Scene(PUSHER)).compile()
    delay = effect_class("actuator_delay")
    assert delay.single_targets(m) == (("shoulder",), ("elbow",))
    both, elbow = delay("shoulder", "elbow"), delay("elbow")
    assert is_single_of_many(elbow, [both, elbow])
    assert not is_single_of_many(both, [both, elbow])
    assert [label(e, [both, elbow]) for e in (both, elbow)] == ["actuator_delay", "actuator_delay(elbow)"]
    backlash = effect_class("backlash")
    assert not is_single_of_many(backlash("elbow"), [backlash("shoulder", "elbow"), backlash("elbow")])
