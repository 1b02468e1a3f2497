"""The page of a tracked video, and its live view."""
