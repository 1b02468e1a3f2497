"""Checks of a recording: clocks, magnitudes, images, scene text."""
