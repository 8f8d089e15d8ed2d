"""Vertex connection and merging: connections of paths from both ends, and photons, combined by MIS weights."""
