"""Shots: scenes over time, cameras along paths, and where what is seen was one frame before."""
