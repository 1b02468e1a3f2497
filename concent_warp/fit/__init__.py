"""Fitting contact geometry to recordings."""
