"""Contact geometry: spheres that stand for the objects in contact."""
