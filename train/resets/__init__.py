"""Initial states of episodes along the demonstration (paper, appendix D).

`sample` is the entry; `reset_states` samples the states of one stage, `chained` those of a chain of stages; the modules
on inverse kinematics bring the hand to displaced poses, one state after the other or all at once.
"""
