"""What was measured and what was commanded: the recording, its file and its readers."""
