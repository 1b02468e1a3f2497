"""One module a machine."""
