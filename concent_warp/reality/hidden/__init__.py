"""Hidden effects of Reality, by means of their own."""
