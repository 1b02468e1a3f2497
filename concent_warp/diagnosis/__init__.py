"""Comparison of a model with measurements."""
