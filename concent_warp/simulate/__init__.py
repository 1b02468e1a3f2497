"""Engines that simulate many variants of a model at once, and the replay of recordings."""
