"""Photons: light paths kept in a map, and the light gathered from those near a point."""
