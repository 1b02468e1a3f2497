"""Bodies, joints, actuators and sensors as MJCF, and the contact geometry of objects."""
