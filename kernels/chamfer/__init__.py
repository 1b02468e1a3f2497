"""Chamfer distance and its gradients."""
