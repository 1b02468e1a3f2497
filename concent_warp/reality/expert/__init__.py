"""The scripted expert: path planning, inverse kinematics, and commands that exert forces."""
