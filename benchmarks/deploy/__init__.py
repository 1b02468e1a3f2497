"""Benchmarks of what happens to policies in Reality."""
