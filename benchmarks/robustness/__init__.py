"""Commands that are killed, that find the disk full, and that are started twice in one place."""
