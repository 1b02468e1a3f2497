"""Gradients of the contact geometry through Newton."""
