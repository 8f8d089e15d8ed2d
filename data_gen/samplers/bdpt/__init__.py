"""Bidirectional path tracing: light paths and camera paths, and every way to join them."""
