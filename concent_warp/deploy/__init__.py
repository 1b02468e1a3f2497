"""Deployment of a trained policy: evaluation, live view and rendered data sets.

`evaluate` counts successes in simulation and in Reality; `record_trials` makes its trials a recording, and `explain`
finds why they failed; `play` shows a policy in the browser; `render_dataset` renders episodes to a data set;
`reality_world` makes Reality an environment of `train`; `cfg` holds the settings of all.
"""
