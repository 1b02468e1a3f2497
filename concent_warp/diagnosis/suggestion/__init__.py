"""The next recording: the motion that best separates the hypotheses of a diagnosis, as commands that run."""
