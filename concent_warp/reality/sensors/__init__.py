"""What the instruments and cameras of Reality read."""
