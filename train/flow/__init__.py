"""A policy from cameras, proprioception and a sentence to chunks of actions, by rectified flow (after FLOWER).

Reuss et al., "FLOWER: democratizing generalist robot policies with efficient vision-language-action flow policies",
CoRL 2025. `cfg` has the settings; `dataset` and `frames` read LeRobot data sets; `small_backbone` and
`florence_backbone` encode images and text, `transformer` predicts the velocity of the flow from their tokens, `network`
joins them; `learning` and `train_flow` train; `policy` acts, `receding_horizon` executes its chunks, `export` writes
ONNX.
"""
