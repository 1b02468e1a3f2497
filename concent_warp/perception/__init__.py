"""RGB-D video to object poses and point tracks."""
