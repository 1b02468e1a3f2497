"""Hand-written Warp kernels."""
