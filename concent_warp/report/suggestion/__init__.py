"""The page of a suggested motion: an animation, its commands, and what each hypothesis predicts."""
