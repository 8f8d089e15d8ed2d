"""Training sets: scenes made in code, cameras found by ray casting, and crops rendered by jobs that may be killed."""
