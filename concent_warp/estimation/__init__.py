"""What the measurements say by themselves: noise, motion of joints and bodies, object tracks."""
