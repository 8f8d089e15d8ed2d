"""Reservoirs of paths, kept from frame to frame: a foundation, no sampler yet, so nothing of it is in the registry."""
