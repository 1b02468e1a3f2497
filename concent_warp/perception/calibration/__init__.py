"""Camera calibration: poses, intrinsics and clock offsets of a recording's cameras, with intervals."""
