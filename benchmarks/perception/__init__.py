"""Benchmarks of perception."""
