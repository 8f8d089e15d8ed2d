"""Paths that are kept from frame to frame: the sampler ``restir``, for shots."""
