"""Benchmarks of contact event extraction."""
