"""Chooses sampler, reconstruction method and number of samples: trials of a scene, and plans based on them."""
