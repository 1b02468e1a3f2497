"""A policy tried out: in simulation, in Reality, and before the cameras that make a data set."""
