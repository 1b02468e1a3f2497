"""Surfaces and volumes of objects: primitives, meshes, point clouds, Gaussian splats."""
