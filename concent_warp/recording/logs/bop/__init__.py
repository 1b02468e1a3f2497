"""Scenes of data sets of the BOP benchmark as recordings."""
