"""Benchmarks, each run as `python -m benchmarks.<topic>.<name>`."""
