"""Distillation: from a policy that observes the state of a task, the teacher, to a student that sees.

`cfg` holds the settings, `images` the protocol of what renders, `proprioception` what the robot knows of itself,
`network` the student's network, `augmentation` the changes of images in training, `samples` the buffer of what was
seen, `dagger` the training, `run` its inputs and run folder, `student` the trained policy.

This room knows no renderer: images come from an `ImageSource`, which `deploy.distil` makes of the task's scene, and
`deploy.evaluate` of Reality.
"""
