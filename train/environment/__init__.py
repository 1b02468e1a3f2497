"""The vectorised environment."""
