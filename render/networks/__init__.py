"""Flow matching and super-resolution networks."""
