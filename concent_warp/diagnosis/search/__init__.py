"""The search for missing effects: additions, their revision, and what else could explain the data."""
