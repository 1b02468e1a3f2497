"""Data sets of rendered episodes, for policies that act on images."""
