"""Images of simulated worlds as real cameras see them (paper, appendix E).

`raw` ray-traces the simulation; `networks` paint robot and background; `splats` show the objects and `shadows` their
shadows; `composite` combines the layers; `filming` writes episodes to a data set of `dataset`; `figure` shows the
layers; `cameras` has calibrations.
"""
