"""Diagnosis of the physical effect that a model lacks, from measurements."""
