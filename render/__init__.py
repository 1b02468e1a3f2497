"""Images of rollouts. Empty in this version."""
