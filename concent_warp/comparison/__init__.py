"""Models against measurements: residuals, phases, tables."""
