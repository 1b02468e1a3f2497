"""Readers of others' logs; what they return has the log's own names and units."""
