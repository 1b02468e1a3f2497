"""Bad input for every command: what is refused, how, and what must be accepted."""
