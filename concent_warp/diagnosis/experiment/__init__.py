"""The next recording that best separates the remaining hypotheses."""
