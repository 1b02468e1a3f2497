"""Shapes of objects, their symmetries, and what cameras see of them."""
