"""Gradients of photons: copies of photons for the camera paths of neighbouring pixels."""
