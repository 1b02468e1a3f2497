"""Benchmarks of reading recordings."""
