"""Tracked poses against the truth: measures of the field, and result files of the BOP benchmark."""
