"""Benchmarks of fitting contact geometry, and of the main job."""
