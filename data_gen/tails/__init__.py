"""A cache of the light that other paths have found, and the rules for paths that end in it."""
