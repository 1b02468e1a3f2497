"""Appearance of Reality to its cameras: speckle patterns of objects, and table, room and lights."""
