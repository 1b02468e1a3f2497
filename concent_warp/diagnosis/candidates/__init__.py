"""Candidates of one addition: screened, fitted beside a baseline, and weighed."""
