"""Unexplained forces by joint and by body."""
