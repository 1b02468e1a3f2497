"""Reset states along the demonstration."""
