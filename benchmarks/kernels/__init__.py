"""Benchmarks of kernels and engines."""
