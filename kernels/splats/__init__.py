"""Rasterisation of Gaussian splats."""
