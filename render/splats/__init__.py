"""Gaussian splats: rasterisation and fit."""
