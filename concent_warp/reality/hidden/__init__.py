"""Hidden effects of Reality, implemented independently of the library's effects.

`registry` has all by name and `sizes` their magnitudes on each rig; `in_task` applies them to a policy's task. The
other modules group the effects: joints, drives, gears, objects, contact, surroundings, measurement, and those `outside`
the library.
"""
