"""A pose against a frame: residuals, refinement, and the search for a first pose."""
