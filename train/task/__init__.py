"""What is trained: model, demonstration, contact events, robot."""
