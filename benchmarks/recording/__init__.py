"""Logs of other systems, written by their own packages, read back."""
