"""Benchmarks of images and data sets."""
