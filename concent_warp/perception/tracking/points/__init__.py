"""Poses from points that are tracked in the images."""
