"""The project as software: what its tests notice."""
