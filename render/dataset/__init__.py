"""Data sets of rendered episodes for image policies.

`layout` defines episodes and the data set that grows by them; `lerobot` and `robomimic` write the two formats; `video`
encodes frames, `statistics` summarises channels.
"""
