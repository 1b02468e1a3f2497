"""Images of rollouts: simulated, painted by networks, composed with Gaussian splats; data sets of them."""
