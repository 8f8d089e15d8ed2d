"""Vertex connection and merging: paths from both ends that are joined, and photons gathered, under one weight."""
