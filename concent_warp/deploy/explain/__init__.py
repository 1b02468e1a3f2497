"""Why trials of a policy failed: perception, physics, or the policy itself.

`explain` judges recorded trials; `measured_start` finds where they began; `own_simulation` asks what the policy's own
simulation predicts from there; `free_motion` compares the robot's motion before contact, and `arm_alone` is the model
in which effects are searched for in it; `pose_bias` finds a constant error of perceived poses; `page` shows the
result.
"""
