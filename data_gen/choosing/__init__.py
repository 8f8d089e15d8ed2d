"""The choice of sampler, method and number of samples: trials of a scene, and plans made from them."""
