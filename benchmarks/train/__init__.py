"""Benchmarks of training and of the policies in Reality."""
