"""The physical effects that come with the package."""
