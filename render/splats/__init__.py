"""Gaussian splats of objects.

`splats` represents and stores them, `rasterise` renders them, `fit` optimises them from the images of `views` and the
initial points of `initial`; `cfg` has the settings.
"""
