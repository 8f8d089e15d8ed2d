"""Photon mapping: light paths are kept in a map, and light is gathered from photons near a point."""
