"""A trained policy: evaluation, episodes, export, the pretrained ones."""
