"""A simulated stand-in for the real world, built on other assumptions than the models that are fitted to it."""
