"""Light that other paths have found: a cache of radiance in the world, and which vertices may end a path in it."""
