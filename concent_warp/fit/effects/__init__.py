"""Effect parameters and initial states by robust least squares."""
