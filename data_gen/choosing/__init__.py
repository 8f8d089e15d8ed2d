"""Which sampler, how many samples, which method: trials of a scene, and plans made of them."""
